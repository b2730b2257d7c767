// Panel: the hierarchy of bounding spheres where the user stands.

import { settings } from "../settings.js";
import { BoundingSpheres, RAMP } from "../spheres.js";
import { foldingPanel, note } from "./folding.js";
import { slider, toggle } from "./registry.js";

// The spheres are those around the user's middle; they are asked for again after this way [m].
const WAY = 0.5, ASK_MS = 200, LOST_MS = 5000;
// Largest level before the depth of the hierarchy is known.
const FIRST_DEPTH = 8;

export function addHierarchyPanel(app) {
  const { body, seen } = foldingPanel("Hierarchy",
    "The bounding spheres of one level of the search tree in the voxels around you: a query descends it from level 0.", "openHierarchy");
  const spheres = new BoundingSpheres(app.view.lines);
  app.drawings.add(spheres);
  toggle(body, "spheres", "Show spheres and their voxels");
  let depth = FIRST_DEPTH;
  const input = slider(body, "level", "Level", { min: 0, max: depth, step: 1 }, (value) => `${Math.min(value, depth)} of ${depth}`);
  const ramp = document.createElement("div"), ends = document.createElement("div");
  ramp.className = "ramp";
  ramp.style.background = RAMP;
  ends.className = "ends";
  const [least, greatest] = [0, 1].map(() => {
    const end = document.createElement("span");
    ends.append(end);
    return end;
  });
  body.append(ramp, ends);
  const text = note(body);
  let asked = null, time = -Infinity, waiting = false, found = null;
  const wanted = () => seen() && settings.get("spheres");
  app.readable.spheres = () => (found && wanted() ? { ...found, drawn: spheres.drawn } : null);

  app.on("spheres", (message) => {
    waiting = false;
    const { level, total, points, radii, shades, arrays } = message;
    if (depth !== message.depth) {
      depth = Math.max(1, message.depth);
      input.max = depth;
      input.value = settings.get("level");
      input.nextElementSibling.textContent = `${input.value} of ${depth}`;
      input.setAttribute("aria-valuetext", `${input.value} of ${depth}`);
    }
    found = { level: Math.min(level, depth), total, points, radii, shades, voxels: arrays.low.rows };
    if (radii) spheres.take(message);
    spheres.show(wanted());
    show();
  });

  const ask = () => {
    spheres.show(wanted());
    const now = performance.now();
    if (!wanted() || !app.state || (waiting && now - time < LOST_MS)) return;
    const { pose } = app.state;
    const place = pose.slice(0, 3).map((row) => row[3]);
    place[2] += app.users.height / 2;
    const level = settings.get("level");
    const key = `${app.scene?.name}/${app.scene?.generation}`;
    const same = asked && asked.level === level && asked.key === key
      && Math.hypot(...place.map((value, k) => value - asked.place[k])) < WAY;
    if (same) return;
    asked = { level, place, key };
    time = now;
    waiting = true;
    app.link.send({ type: "spheres", place, level });
  };
  setInterval(ask, ASK_MS);
  for (const name of ["spheres", "level"]) settings.follow(name, () => { ask(); show(); });
  app.whenSeen(seen, ask);

  function show() {
    ramp.hidden = ends.hidden = !wanted() || !found?.radii;
    if (!wanted()) text.textContent = "";
    else if (!found) text.textContent = "Reading…";
    else if (!found.radii) text.textContent = "No voxels here.";
    else {
      const { level, total, points, radii, shades, voxels } = found;
      [least, greatest].forEach((end, k) => { end.textContent = `radius ${length(shades[k])}`; });
      const all = total.toLocaleString("en");
      const drawn = spheres.drawn < total ? `the nearest ${spheres.drawn.toLocaleString("en")} of ${all} spheres` : `${all} spheres`;
      text.textContent = `Level ${level}: ${drawn} with radii of ${length(radii[0])} to ${length(radii[1])}, around the centres of `
        + `${points.toLocaleString("en")} points in ${voxels} voxels (white boxes).`
        + `${level < depth ? " Leaf nodes that end above this level are among them." : " All are leaf nodes."}`
        + `${app.view.software ? " This browser draws without a graphics processor: spheres are drawn while the view rests." : ""}`;
    }
  }
}

/** Return a length as text. */
function length(metres) {
  return metres < 0.1 ? `${(1000 * metres).toFixed(0)} mm` : `${(100 * metres).toFixed(0)} cm`;
}
