// The clash check: sends a path to the process, and keeps what comes back.

import { Ghost } from "./ghost.js";
import { PathLine } from "./path_line.js";

// Characters of one message, and of a whole file, that the process takes.
const PART = 10_000, MOST = 32 * 2 ** 20;

export class ClashCheck {
  constructor(app) {
    this.app = app;
    this.line = new PathLine(app.view.lines);
    this.ghost = new Ghost(app.view.lines);
    this.listeners = [];
    this.reset();
  }

  /** Call a function after every change. */
  follow(listener) {
    this.listeners.push(listener);
    listener();
  }

  changed() {
    for (const listener of this.listeners) listener();
  }

  reset() {
    this.state = "none";
    this.done = 0;
    this.name = "";
    this.message = "";
    this.result = null;
    this.selected = 0;
    this.shown = null;
    this.line.clear();
    this.leave();
    this.changed();
  }

  handlers() {
    return {
      path: ({ name, arrays }) => {
        this.reset();
        Object.assign(this, { state: "running", name });
        this.line.show(arrays.places.array);
        this.changed();
      },
      clearances: ({ first, arrays }) => {
        this.line.take(first, arrays);
        this.changed();
      },
      check: (message) => this.report(message),
      clashes: (message) => {
        Object.assign(this, { state: "done", done: 1, name: message.name, result: message });
        this.changed();
      },
      clash: (message) => {
        this.shown = message;
        this.app.rig.watch(message.eye, message.target);
        this.ghost.show(message, this.app.users.geometry, this.app.users.radius);
        this.changed();
      },
      file: ({ name, media, arrays }) => {
        if (this.result) this.state = "done";
        download(new Blob([arrays.content.array], { type: media }), name);
        this.changed();
      },
    };
  }

  report({ state, done, name, message }) {
    if (state === "failed") {
      // A file that could not be written leaves the list.
      if (this.result && !name) this.state = "done";
      else {
        this.reset();
        Object.assign(this, { state, name });
      }
      this.message = message;
    } else if (state === "stopped") this.state = "done";
    else if (this.state !== "done" || state === "saving") Object.assign(this, { state, done, message: "" });
    this.changed();
  }

  /** Send a file of poses. file: of the browser. */
  async load(file) {
    const text = await file.text();
    this.reset();
    if (text.length > MOST) {
      this.report({ state: "failed", name: file.name, message: `${file.name} has ${text.length.toLocaleString("en")} characters: at most ${MOST.toLocaleString("en")}: check it in pieces.` });
      return;
    }
    if (!this.app.link.open) {
      this.report({ state: "failed", name: file.name, message: "The viewer has ended: start it again, then load the path." });
      return;
    }
    Object.assign(this, { state: "running", name: file.name });
    this.changed();
    const name = file.name.slice(-255);
    let first = 0;
    do {
      let end = Math.min(text.length, first + PART);
      // A character of two code units is not split.
      if (/[\uD800-\uDBFF]/.test(text.charAt(end - 1)) && end < text.length) end -= 1;
      this.app.link.send({ type: "path", name, text: text.slice(first, end), first: first === 0, last: end >= text.length });
      first = end;
    } while (first < text.length);
  }

  cancel() {
    this.app.link.send({ type: "stop" });
  }

  /** Go to a clash, by its number in the list from 1. */
  show(number) {
    if (!this.result || number < 1 || number > this.result.clashes.length) return;
    this.selected = number;
    this.app.link.send({ type: "show", number });
    this.changed();
  }

  /** Go to the next clash of the list, or the one before. */
  step(way) {
    const count = this.result?.clashes.length ?? 0;
    if (!count) return;
    const from = this.selected || (way > 0 ? 0 : 1);
    this.show(((from - 1 + way + count) % count) + 1);
  }

  /** Return the view to the user. */
  leave() {
    this.app.rig.leave();
    this.ghost.hide();
    this.shown = null;
    this.changed();
  }

  /** Ask for the clashes as a file. */
  save(form) {
    if (!this.result) return;
    if (form === "bcf") Object.assign(this, { state: "saving", done: 0 });
    this.app.link.send({ type: "save", form });
    this.changed();
  }

  /** Save the picture as it is shown. */
  savePicture() {
    const { view } = this.app;
    // The canvas keeps its pixels only until the browser has shown them.
    view.draw();
    view.shownCanvas.toBlob((blob) => { if (blob) download(blob, `${this.app.scene?.name ?? "solidcloud"}.png`); }, "image/png");
  }

  /** Return a text that changes with what is drawn. */
  get signature() {
    return `${this.line.version},${this.ghost.version}`;
  }
}

function download(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
