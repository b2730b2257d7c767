// Panel: record the own walk, save it, load one, and play it back as a ghost.

import { notify } from "../notices.js";
import { Ghost } from "../walk/ghost.js";
import { csvText, parseWalk, tumText } from "../walk/pose_text.js";
import { Recorder } from "../walk/recorder.js";
import { buttons, choice, panel } from "./registry.js";

const SPEEDS = [0.25, 0.5, 1, 2, 4];
// Larger than a walk of an hour in full precision [bytes].
const MOST_BYTES = 32 << 20;

export function addWalkPanel(app) {
  const section = panel("Record and replay");
  const recorder = new Recorder(() => {
    stop();
    notify("walk", "The recording has ended", "A recording lasts an hour at most.", "warn", 8);
  });
  const ghost = new Ghost(app);
  let name = "", saved = "";

  const file = document.createElement("input");
  Object.assign(file, { type: "file", accept: ".csv,.tum,.txt", hidden: true });
  file.setAttribute("aria-label", "File of poses");
  buttons(section, ["Record", () => record()], ["Load", () => file.click()]);
  const [recordButton] = section.querySelectorAll("button");
  recordButton.setAttribute("aria-keyshortcuts", "T");
  const note = document.createElement("p");
  note.setAttribute("role", "status");

  const player = document.createElement("div");
  player.hidden = true;
  const label = document.createElement("label");
  const slider = document.createElement("input"), output = document.createElement("output");
  Object.assign(slider, { type: "range", min: 0, step: "any", value: 0 });
  slider.setAttribute("aria-label", "Time of the walk");
  slider.style.flex = "1";
  label.append(slider, output);
  player.append(label);
  const speed = choice(player, "Speed", SPEEDS.map((value) => [value, `${value} × speed`]), (value) => {
    ghost.speed = Number(value);
  });
  speed.value = 1;
  buttons(player, ["Play", () => ghost.toggle()], ["Remove", () => take(null, "")]);
  buttons(player, ["Save as CSV", () => save(csvText, "csv")], ["Save as TUM", () => save(tumText, "tum")]);
  const [playButton] = player.querySelectorAll("button");
  playButton.setAttribute("aria-keyshortcuts", "P");
  section.append(note, player, file);

  function take(walk, title) {
    name = title;
    ghost.show(walk);
    slider.max = ghost.seconds;
    player.hidden = !walk;
    describe();
  }

  function record() {
    if (recorder.on) stop();
    else if (!app.state) notify("walk", "There is no walk to record", "The user is in no scene yet.", "warn", 5);
    else {
      recorder.start();
      describe();
    }
  }

  function stop() {
    const walk = recorder.stop();
    if (walk.length > 1) take(walk, "recorded walk");
    describe();
  }

  function describe() {
    recordButton.textContent = recorder.on ? "Stop" : "Record";
    recordButton.setAttribute("aria-pressed", String(recorder.on));
    const text = recorder.on ? `Recording: ${Math.floor(recorder.seconds)} s`
      : ghost.walk ? `${name}: ${ghost.seconds.toFixed(1)} s, ${ghost.walk.length.toLocaleString("en")} poses` : "";
    if (text !== saved) note.textContent = saved = text;
  }

  function save(format, suffix) {
    const address = URL.createObjectURL(new Blob([format(ghost.walk)], { type: "text/plain" }));
    const link = document.createElement("a");
    link.href = address;
    link.download = `walk-${app.scene?.name ?? "scene"}.${suffix}`;
    link.click();
    // The browser has begun to read it by then.
    setTimeout(() => URL.revokeObjectURL(address), 10_000);
  }

  file.addEventListener("change", async () => {
    const [chosen] = file.files;
    // The same file can be chosen again.
    const text = !chosen ? null : chosen.size > MOST_BYTES ? "" : await chosen.text();
    file.value = "";
    if (text === null) return;
    try {
      if (chosen.size > MOST_BYTES) throw new Error(`${chosen.name}: larger than 32 MiB: divide it`);
      take(parseWalk(chosen.name, text), chosen.name);
    } catch (error) {
      notify("walk", "This file is no walk", error.message, "warn", 10);
    }
  });
  slider.addEventListener("input", () => ghost.seek(Number(slider.value)));
  ghost.changed = () => {
    slider.value = ghost.time;
    output.textContent = `${ghost.time.toFixed(1)} s`;
    slider.setAttribute("aria-valuetext", output.textContent);
    playButton.textContent = ghost.playing ? "Pause" : "Play";
  };
  app.frameListeners.add((state) => {
    recorder.take(state, app.origin, app.axes);
    if (recorder.on) describe();
  });
  app.movers.add(ghost);
  app.input.actions.KeyT = record;
  app.input.actions.KeyP = () => ghost.toggle();
  app.readable.walk = () => ({
    recording: recorder.on, samples: recorder.on ? recorder.samples.length : ghost.walk?.length ?? 0,
    seconds: ghost.seconds, time: ghost.time, playing: ghost.playing, place: ghost.worldPlace(),
  });
}
