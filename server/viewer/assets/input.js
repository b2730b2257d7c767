// What the user wants: keys, pointer, wheel, touch and gamepad, as one intent.

import { settings } from "./settings.js";

const FORWARD = ["KeyW", "ArrowUp"], BACK = ["KeyS", "ArrowDown"];
const LEFT = ["KeyA", "ArrowLeft"], RIGHT = ["KeyD", "ArrowRight"];
const UP = ["PageUp", "KeyR"], DOWN = ["PageDown", "KeyF"];
// Angles of a dragged or moved pointer [rad per pixel], and of keys and sticks [rad/s].
const PER_PIXEL = 0.0042, PER_SECOND = 1.9;
const DEAD = 0.16;

export class Input {
  /** rig: the camera that looks.  actions: functions by the code of a key. */
  constructor(canvas, rig, actions) {
    this.canvas = canvas;
    this.rig = rig;
    this.actions = actions;
    this.keys = new Set();
    this.stick = { x: 0, y: 0 };
    this.pad = { x: 0, y: 0, run: false, buttons: [] };
    addEventListener("keydown", (event) => this.keyDown(event));
    addEventListener("keyup", (event) => this.keys.delete(event.code));
    addEventListener("blur", () => this.keys.clear());
    document.addEventListener("visibilitychange", () => this.keys.clear());
    this.pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => this.pointerDown(event));
    canvas.addEventListener("pointermove", (event) => this.pointerMove(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      rig.zoom(Math.sign(event.deltaY));
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    this.touchStick(document.getElementById("stick"));
  }

  keyDown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { target, code } = event;
    // A list or a slider uses these keys itself.
    const busy = target instanceof HTMLSelectElement || target instanceof HTMLInputElement;
    if (busy && (code.startsWith("Arrow") || code.startsWith("Page") || target.type === "text")) return;
    if (this.actions[code] && !event.repeat) {
      this.actions[code]();
      event.preventDefault();
      return;
    }
    this.keys.add(code);
    if (/^(Arrow|Page)/.test(code) && target === this.canvas) event.preventDefault();
  }

  pointerDown(event) {
    this.canvas.focus({ preventScroll: true });
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (event.pointerType === "mouse" && settings.get("firstPerson")) {
      // Some browsers refuse it, for example just after it was left.
      this.canvas.requestPointerLock?.()?.catch?.(() => {});
    } else {
      this.canvas.setPointerCapture(event.pointerId);
    }
    if (event.pointerType === "touch") document.getElementById("stick").hidden = false;
  }

  pointerMove(event) {
    if (document.pointerLockElement === this.canvas) {
      this.rig.look(-event.movementX * PER_PIXEL * 0.6, -event.movementY * PER_PIXEL * 0.6);
      return;
    }
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    if (this.pointers.size === 2) {
      const spread = () => {
        const [one, other] = [...this.pointers.values()];
        return Math.hypot(one.x - other.x, one.y - other.y);
      };
      const was = spread();
      Object.assign(before, { x: event.clientX, y: event.clientY });
      this.rig.zoom((was - spread()) / 24);
      return;
    }
    this.rig.look(-(event.clientX - before.x) * PER_PIXEL, -(event.clientY - before.y) * PER_PIXEL);
    Object.assign(before, { x: event.clientX, y: event.clientY });
  }

  /** Make the stick on the screen follow a finger. */
  touchStick(element) {
    const knob = element.firstElementChild;
    const place = (event) => {
      const box = element.getBoundingClientRect();
      const half = box.width / 2;
      const x = (event.clientX - box.left - half) / half, y = (event.clientY - box.top - half) / half;
      const length = Math.max(1, Math.hypot(x, y));
      this.stick = { x: x / length, y: y / length };
      knob.style.transform = `translate(${this.stick.x * 34}px, ${this.stick.y * 34}px)`;
    };
    const release = () => {
      this.stick = { x: 0, y: 0 };
      knob.style.transform = "";
    };
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      place(event);
    });
    element.addEventListener("pointermove", (event) => {
      if (element.hasPointerCapture(event.pointerId)) place(event);
    });
    element.addEventListener("pointerup", release);
    element.addEventListener("pointercancel", release);
    if (matchMedia("(pointer: coarse)").matches) element.hidden = false;
  }

  /** Read the first gamepad: left stick walks, right stick looks, A runs, Y changes the view. */
  gamepad(seconds) {
    const pad = navigator.getGamepads?.().find((each) => each?.mapping === "standard");
    if (!pad) {
      this.pad = { x: 0, y: 0, run: false, buttons: [] };
      return;
    }
    const axis = (k) => (Math.abs(pad.axes[k] ?? 0) < DEAD ? 0 : pad.axes[k]);
    const pressed = pad.buttons.map((button) => button.pressed);
    if (pressed[3] && !this.pad.buttons[3]) this.actions.KeyV?.();
    this.pad = { x: axis(0), y: axis(1), run: pressed[0] || pressed[10], buttons: pressed };
    this.rig.look(-axis(2) * 1.5 * PER_SECOND * seconds, -axis(3) * PER_SECOND * seconds);
  }

  held(codes) {
    return codes.some((code) => this.keys.has(code)) ? 1 : 0;
  }

  /** Read everything, turn the view, and return the intent. seconds: since the last picture. */
  read(seconds) {
    this.gamepad(seconds);
    this.rig.look((this.held(["KeyQ"]) - this.held(["KeyE"])) * PER_SECOND * seconds, 0);
    const within = (value) => Math.max(-1, Math.min(1, value));
    const firstPerson = settings.get("firstPerson");
    return {
      type: "intent",
      forward: within(this.held(FORWARD) - this.held(BACK) - this.stick.y - this.pad.y),
      right: within(this.held(RIGHT) - this.held(LEFT) + this.stick.x + this.pad.x),
      up: this.held(UP) - this.held(DOWN),
      yaw: this.rig.yaw,
      run: this.pad.run || this.held(["ShiftLeft", "ShiftRight"]) === 1,
      face: firstPerson,
    };
  }
}
