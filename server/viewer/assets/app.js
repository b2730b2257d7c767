// The parts of the page together: messages in, pictures out.

import { Vector3 } from "./vendor/three.module.min.js";
import { Users } from "./avatar.js";
import { Boxes } from "./boxes.js";
import { CameraRig } from "./camera.js";
import { ClashCheck } from "./clash/check.js";
import { VERDICTS } from "./colours.js";
import { Contacts } from "./contacts.js";
import { Input } from "./input.js";
import { Link } from "./link.js";
import { clear, notify, subjects } from "./notices.js";
import { Overview } from "./overview.js";
import { shared } from "./points_material.js";
import { Quality } from "./quality.js";
import { settings } from "./settings.js";
import { showFigures, showProcess, showServer, showSight, showState, showVerdict, verdictOf } from "./status.js";
import { Tiles } from "./tiles.js";

// Numbers of the verdicts in the server's answers.
const NAMES = ["clear", "contact", "unknown"];
const KEPT_INTERVALS = 600;
// Without a user for this long, the scan as a whole is looked at in detail [ms].
const USER_MS = 4000;
// Until then nothing is said of a user who is not there, or sees nothing [ms].
const PLACING_MS = 1500, UNSEEN_MS = 1500;
const INTENT_MS = 1000 / 30, CHOOSE_MS = 180, FIGURES_MS = 500, BOOM_MS = 100;
// Radius around the camera of what is not drawn between it and the user [m].
const CUT = 0.9;
// A user who begins farther than this from the link's place is told so [m].
const NOT_THERE = 0.3;
// Shown until the first step, once for a browser.
const HINT = ["Walk with W A S D or the arrow keys", "Look by dragging; Shift runs. All keys are at the end of the settings."];
const HINT_TOUCH = ["Walk with the round stick", "Look by dragging; two fingers go nearer and farther."];

/** Return a number without the noise of interpolation. */
const digits = (value) => value.toFixed(5);

export class App {
  /** view: the picture.  at: place of the link, or null. */
  constructor(view, at) {
    this.view = view;
    this.rig = new CameraRig(view.camera);
    this.overview = new Overview(view.points);
    this.tiles = new Tiles(view.points, (message) => this.link.send(message),
      (voxel) => this.overview.cover(voxel.name, voxel.box));
    this.users = new Users(view.points);
    this.boxes = new Boxes(view.lines);
    this.contacts = new Contacts(view.lines);
    this.clash = new ClashCheck(this);
    this.quality = new Quality(view.software, view.drawing !== null);
    this.scene = null;
    this.state = null;
    this.verdict = "none";
    this.server = "none";
    this.connected = false;
    this.pictured = false;
    this.origin = null;
    this.colour = "height";
    this.refreshColours = () => {};
    this.nextColour = () => {};
    this.frames = 0;
    this.pictures = 0;
    this.fps = 0;
    // Of pictures that moved [ms].
    this.intervals = [];
    this.times = { picture: performance.now(), drawn: 0, intent: 0, choose: 0, figures: 0, boom: 0, seen: performance.now() };
    this.lastIntent = "";
    this.asked = false;
    // For panels: called with each state of the user, and with each refusal of the server; what else
    // is drawn, each with a `signature` that changes with it and a method `prepare`; what moves by
    // itself, each with `update` and a `signature`; functions by name that tests may call.
    this.frameListeners = new Set();
    this.problemListeners = new Set();
    this.drawings = new Set();
    this.movers = new Set();
    this.readable = {};
    // Names of the effects that the server is being started with, or null.
    this.switching = null;
    this.input = new Input(view.canvas, this.rig, {
      KeyV: () => settings.toggle("firstPerson"),
      KeyB: () => settings.toggle("boxes"),
      KeyN: () => settings.toggle("contacts"),
      KeyL: () => settings.toggle("clearance"),
      KeyC: () => this.nextColour(),
      KeyH: () => this.restart(null),
      Period: () => this.clash.step(1),
      Comma: () => this.clash.step(-1),
      Escape: () => this.clash.leave(),
    });
    this.link = new Link(at, this.handlers(), (connected, reason) => {
      this.connected = connected;
      if (!connected) {
        this.forgetUser();
        this.clash.reset();
      }
      showProcess(connected, reason);
    });
    this.follow();
  }

  /** Follow the settings that the picture depends on. */
  follow() {
    settings.follow("contacts", (value) => { this.contacts.showContacts = value; });
    settings.follow("clearance", (value) => { this.contacts.showLine = value; });
    settings.follow("pointSize", (value) => {
      this.tiles.pointSize = value;
      this.times.choose = 0;
    });
    settings.follow("firstPerson", (value) => {
      document.getElementById("crosshair").hidden = !value;
      if (!value && document.pointerLockElement) document.exitPointerLock();
    });
  }

  handlers() {
    return {
      ...this.clash.handlers(),
      boom: ({ free }) => this.rig.bound(free),
      status: (message) => {
        if (!this.switching || message.state === "connected") showServer(message, this.server);
        this.server = message.state;
      },
      welcome: (message) => this.welcome(message),
      avatar: (message) => this.users.shape(message),
      overview: (message) => {
        this.overview.take(message, this.tiles.columns);
        if (this.overview.object) shared.uHeight.value.set(...this.overview.heights());
        for (const voxel of this.tiles.voxels.values()) if (voxel.object) this.overview.cover(voxel.name, voxel.box);
        this.refreshColours();
      },
      residency: (message) => this.tiles.change(message),
      voxels: (message) => this.tiles.list(message),
      tile: (message) => {
        const before = this.tiles.columns.size;
        this.tiles.take(message);
        if (this.tiles.columns.size !== before) this.refreshColours();
      },
      missing: (message) => {
        this.tiles.miss(message);
        if (!message.again) notify("tile", "A part of the scan cannot be read", message.message, "unknown", 6);
      },
      entered: () => {
        this.entered = true;
        clear("problem");
      },
      frame: (message) => this.frame(message),
      problem: ({ message }) => {
        for (const listener of this.problemListeners) listener(message);
        notify("problem", "The server refused", message, "warn", 6);
      },
    };
  }

  /** Call a function with each message of a type, after those that are called already. */
  on(type, handler) {
    const before = this.link.handlers[type];
    this.link.handlers[type] = before ? (message) => { before(message); handler(message); } : handler;
  }

  /** Call a function whenever a panel of "What is going on" comes into sight. seen: whether it is. */
  whenSeen(seen, appears) {
    for (const name of ["instruments", "openPlots", "openEffects", "openAccuracy", "openHierarchy"]) {
      settings.follow(name, () => { if (seen()) appears(); });
    }
  }

  welcome({ scene, frame, number }) {
    const another = this.scene?.name !== scene.name || this.scene?.generation !== scene.generation;
    this.scene = scene;
    this.welcomed = performance.now();
    this.number = number;
    this.origin = frame.origin;
    this.axes = frame.axes;
    document.getElementById("scene-name").textContent =
      `${scene.name} · ${scene.points.toLocaleString("en")} points`;
    document.title = `${scene.name} · solidcloud`;
    if (another) {
      this.tiles.clear();
      this.overview.clear();
      this.clash.reset();
    }
    this.tiles.radius = Math.max(scene.radius, 1e-4);
    const height = scene.high[2] - scene.low[2];
    shared.uHeight.value.set(scene.low[2], scene.low[2] + Math.max(0.5, Math.min(height, 14)));
    shared.uFog.value = Math.max(25, Math.min(140, 0.6 * Math.hypot(...scene.high.map((v, k) => v - scene.low[k]))));
    if (scene.unknown) {
      notify("scans", "Scans are missing", "Scans were left out of this archive: where they lie, no way is known to be clear.", "unknown", 8);
    }
    this.rig.show(scene.low, scene.high);
    this.refreshColours();
  }

  frame(message) {
    const { state } = message;
    const first = this.state === null;
    this.state = state;
    this.frames += 1;
    this.verdict = verdictOf(state);
    const now = performance.now();
    this.users.frame(message, this.verdict, NAMES, now);
    this.contacts.take(state, now);
    for (const listener of this.frameListeners) listener(state);
    showVerdict(this.verdict);
    showState(state);
    if (this.entered) {
      this.checkStart();
      if (!settings.get("walked")) notify("hint", ...(matchMedia("(pointer: coarse)").matches ? HINT_TOUCH : HINT));
    }
    if (first || this.entered) {
      this.entered = false;
      // The avatar faces along its y axis.
      this.rig.yaw = Math.atan2(state.pose[1][1], state.pose[0][1]);
      this.rig.started = false;
    }
  }

  /** Say why the user is not at the link's place: the server begins all users at the scene's spawn. */
  checkStart() {
    const { at } = this.link, place = this.place();
    if (!at || !place || !this.scene.spawn) return;
    const away = Math.hypot(...place.slice(0, 3).map((value, k) => value - at[k]));
    if (away < NOT_THERE) return;
    notify("place", "You are not at the link's place", `All users of this scene begin at its spawn, and something stops the way from there. The place is ${away.toFixed(1)} m from here: walk to it.`, "warn", 15);
  }

  forgetUser() {
    this.state = null;
    this.verdict = "none";
    showVerdict("none");
    this.users.leave();
  }

  /** Put the user back to the start, or to a place. */
  restart(at) {
    this.link.at = at;
    this.link.send({ type: "restart", at });
  }

  /** Return where the user is in the world: x, y, z [m] and direction [degrees]; null before it is somewhere. */
  place() {
    if (!this.state || !this.axes) return null;
    const { pose } = this.state;
    const [x, y, z] = pose.slice(0, 3).map((row) => row[3]);
    const world = this.origin.map((value, k) => value + x * this.axes[0][k] + y * this.axes[1][k] + z * this.axes[2][k]);
    return [...world, (Math.atan2(pose[1][1], pose[0][1]) * 180) / Math.PI];
  }

  placeLink() {
    const place = this.place();
    if (!place) return null;
    const link = new URL(location.href);
    link.searchParams.set("at", place.map((value, k) => value.toFixed(k < 3 ? 3 : 1)).join(","));
    return link.href;
  }

  /** Draw a picture. now: [ms]. */
  picture(now) {
    const seconds = Math.min(0.2, (now - this.times.picture) / 1000);
    this.times.picture = now;
    const intent = this.input.read(seconds);
    // Where there is gravity, it decides.
    if (this.scene?.effects.includes("ground")) intent.up = 0;
    // Who walks looks at the user again.
    if (this.rig.watched && (intent.forward || intent.right || intent.up)) this.clash.leave();
    if (this.state && (intent.forward || intent.right) && !settings.get("walked")) {
      settings.set("walked", true);
      clear("hint");
    }
    const { watched } = this.rig;
    const firstPerson = settings.get("firstPerson") && !watched;
    this.asked = intent.forward !== 0 || intent.right !== 0 || intent.up !== 0;
    this.command(watched ? { ...intent, face: false } : intent, now);
    if (this.state && !watched && !firstPerson && now - this.times.boom > BOOM_MS) {
      this.times.boom = now;
      this.link.send({ type: "boom", ...this.rig.boom() });
    }
    this.users.update(now, firstPerson);
    const own = this.users.own;
    if (own && this.state) {
      if (!watched) this.rig.follow(own.position, this.users.height, firstPerson, seconds);
      shared.uUser.value.copy(own.position);
      shared.uCut.value.set(own.position.x, own.position.y, own.position.z + 0.6 * this.users.height, firstPerson || watched ? 0 : CUT);
      const [r, g, b] = VERDICTS[this.verdict] ?? VERDICTS.unknown;
      shared.uVerdict.value.set(r / 255, g / 255, b / 255, this.users.height);
    }
    if (watched) this.rig.orbit();
    this.contacts.update(now);
    for (const mover of this.movers) mover.update(now);
    if (this.scene && now - this.times.choose > CHOOSE_MS) this.choose(now, own);
    this.draw(now);
    if (now - this.times.figures > FIGURES_MS) this.figures(now);
  }

  /** Choose the details of voxels, and what is missing. */
  choose(now, own) {
    this.times.choose = now;
    const focus = this.rig.watched ? this.rig.watched.target : own ? own.position : this.rig.focus;
    const budget = 1e6 * settings.get("budget");
    const drawn = this.quality.budget(budget, this.view.drawing?.spread ?? 1);
    // Tiles that are seen from afar are of no use beside the user, who stands there soon.
    if (own || this.rig.watched || now - this.welcomed > USER_MS) this.tiles.choose(this.view.camera, focus, budget, drawn, now);
    this.boxes.update(this.tiles, focus, settings.get("boxes"));
    this.overview.update(settings.get("pointSize"), drawn - this.tiles.shown, now);
  }

  /** Draw, if the picture differs from the one before. */
  draw(now) {
    if (this.quality.early(now)) return;
    const { camera, drawing } = this.view;
    const seen = [
      ...[...camera.position.toArray(), ...camera.quaternion.toArray()].map(digits), camera.aspect, this.view.canvas.width,
      this.contacts.signature, this.users.signature, this.verdict, ...[...this.movers].map((mover) => mover.signature),
    ].join();
    const chosen = [
      this.boxes.version, this.boxes.object.visible, this.colour, settings.get("pointSize"),
      settings.get("shading"), settings.get("budget"), this.clash.signature,
      ...[...this.drawings].map((each) => each.signature),
    ].join();
    const content = `${this.tiles.changes},${this.overview.count}`;
    this.pictures += 1;
    if (!this.quality.look(seen, chosen, content, now, this.asked)) {
      this.drawnBefore = false;
      return;
    }
    if (this.quality.still && this.scene) this.choose(now, this.users.own);
    for (const each of this.drawings) each.prepare(!this.quality.software || this.quality.still);
    this.view.shading = this.quality.shading(settings.get("shading"));
    if (this.drawnBefore && !this.quality.still) {
      const interval = now - this.times.drawn;
      this.quality.measure(interval, drawing?.shown.given ?? this.tiles.shown + this.overview.shown, drawing?.times.points ?? 0);
      this.intervals.push(interval);
      if (this.intervals.length > 2 * KEPT_INTERVALS) this.intervals = this.intervals.slice(-KEPT_INTERVALS);
    }
    this.times.drawn = now;
    this.quality.draws(now);
    this.drawnBefore = true;
    this.view.draw();
    this.pictured ||= this.tiles.shown + this.overview.shown > 0;
  }

  /** Return what pictures take: intervals of those that moved since the last call [ms]; parts of our own drawing of the last one [ms], its inner loop, and its points. */
  drawingFigures() {
    const { drawing } = this.view;
    return { intervals: this.intervals.splice(0), most: this.quality.most, still: this.quality.still, canvas: this.view.shownCanvas === this.view.canvas ? "webgl" : "own", ...(drawing && { parts: { ...drawing.times }, loop: drawing.picture.loop, ...drawing.shown }) };
  }

  /** Send the intent when it changes, and again while it lasts. */
  command(intent, now) {
    if (now - this.times.intent < INTENT_MS - 2) return;
    const text = JSON.stringify(intent);
    const moving = intent.forward !== 0 || intent.right !== 0 || intent.up !== 0 || intent.face;
    if (text === this.lastIntent && !(moving && now - this.times.intent > 250)) return;
    this.lastIntent = text;
    this.times.intent = now;
    this.link.send(intent);
  }

  /** Say what a user without a place, or without the scan in view, may wait for or do. points: in the picture. */
  sight(points, now) {
    if (points || !this.state || this.rig.watched) this.times.seen = now;
    const said = ["server", "scene", "process", "problem"].some((subject) => subjects().includes(subject));
    showSight({
      waits: this.scene !== null && !this.state && !said && !this.switching && now - this.welcomed > PLACING_MS,
      sees: this.state ? now - this.times.seen < UNSEEN_MS : null,
    });
  }

  figures(now) {
    this.fps = (1000 * this.pictures) / Math.max(1, now - this.times.figures);
    this.pictures = 0;
    this.times.figures = now;
    const place = this.place();
    const points = this.view.drawing?.shown.inside ?? this.tiles.shown + this.overview.shown;
    this.sight(points, now);
    showFigures({
      points,
      fps: this.fps,
      roundTrip: this.state?.roundTrip ?? null,
      frameSeconds: this.state?.seconds ?? null,
      place: place?.slice(0, 3) ?? null,
    });
    document.getElementById("boxes-count").textContent =
      this.tiles.total ? `${this.tiles.resident} of ${this.tiles.total} voxels, ${(this.tiles.residentBytes / 2 ** 20).toFixed(1)} MiB in memory` : "";
  }
}
