// Start of the page.

import { App } from "./app.js";
import { fatal, subjects } from "./notices.js";
import { addPanels } from "./panels/index.js";
import { settings } from "./settings.js";
import { View } from "./view.js";

/** Return the place of the link, `?at=x,y,z,yaw` [m, degrees], or null. */
function placeOfLink() {
  const text = new URLSearchParams(location.search).get("at");
  if (!text) return null;
  const numbers = text.split(",").map(Number);
  if (numbers.length === 3) numbers.push(90);
  return numbers.length === 4 && numbers.every(Number.isFinite) ? numbers : null;
}

function panelToggle() {
  const button = document.getElementById("panel-toggle"), area = document.getElementById("panel");
  button.addEventListener("click", () => settings.toggle("panel"));
  if (matchMedia("(max-width: 760px)").matches) settings.set("panel", false);
  settings.follow("panel", (open) => {
    area.hidden = !open;
    button.setAttribute("aria-expanded", String(open));
  });
}

/** What tests and curious users may read; nothing of the page depends on it. */
function expose(app) {
  const read = {
    connected: () => app.connected,
    server: () => app.server,
    scene: () => app.scene?.name ?? null,
    place: () => app.place(),
    pose: () => app.state?.pose ?? null,
    verdict: () => app.verdict,
    touched: () => app.state?.touched ?? [],
    contacts: () => app.contacts.marks.filter((mark) => mark.visible).length,
    complete: () => app.quality.complete && app.tiles.missing === 0,
    frames: () => app.frames,
    fps: () => app.fps,
    roundTrip: () => app.state?.roundTrip ?? null,
    shown: () => app.tiles.shown,
    overview: () => app.overview.shown,
    pictured: () => app.pictured,
    missing: () => app.tiles.missing ?? null,
    voxels: () => [...app.tiles.voxels.values()].map(({ name, resident, detail }) => ({ name, resident, detail })),
    boxes: () => app.boxes.object.visible,
    others: () => [...app.users.others.values()].map((each) => each.poses.at(-1).place.toArray()),
    colour: () => app.colour,
    columns: () => [...app.tiles.columns],
    yaw: () => app.rig.yaw,
    notices: () => subjects(),
    software: () => app.view.software,
    drawing: () => app.drawingFigures(),
    ...app.readable,
    camera: () => app.view.camera.position.toArray(),
    watching: () => app.rig.watched !== null,
    clash: () => ({
      state: app.clash.state, message: app.clash.message, result: app.clash.result, selected: app.clash.selected,
      shown: app.clash.shown, ghost: app.clash.ghost.counts, classes: [...app.clash.line.counts],
    }),
  };
  const state = {};
  for (const [name, get] of Object.entries(read)) Object.defineProperty(state, name, { get, enumerable: true });
  Object.defineProperty(window, "solidcloud", { value: Object.freeze(state) });
}

function start() {
  let view;
  try {
    view = new View(document.getElementById("view"), new URLSearchParams(location.search).get("drawing") === "webgl");
  } catch (error) {
    console.info(error);
    fatal("This browser offers no WebGL 2, which the picture needs. Use a current browser, with graphics acceleration on.");
    return;
  }
  panelToggle();
  const app = new App(view, placeOfLink());
  addPanels(app);
  expose(app);
  view.renderer.setAnimationLoop((now) => app.picture(now));
}

start();
