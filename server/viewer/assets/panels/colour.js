// Panel: how the scan is coloured.

import { MODES, VERDICTS, gradients, scanColour, textures } from "../colours.js";
import { setMode, shared } from "../points_material.js";
import { settings } from "../settings.js";
import { choice, panel, slider } from "./registry.js";

export function addColourPanel(app) {
  const section = panel("Colour");
  const select = choice(section, "Colour of the scan", MODES.map(({ name, title }) => [name, title]),
    (value) => settings.set("colour", value));
  const legend = document.createElement("div");
  section.append(legend);
  slider(section, "pointSize", "Point size", { min: 0.4, max: 2.5, step: 0.1 }, (value) => `${value.toFixed(1)} ×`);

  /** Show which colours the archive keeps, and use the chosen one if it does. */
  const refresh = () => {
    for (const [k, { column }] of MODES.entries()) {
      select.options[k].disabled = Boolean(column) && !app.tiles.columns.has(column);
    }
    const wanted = settings.get("colour");
    const found = MODES.find(({ name }) => name === wanted);
    const has = found && (!found.column || app.tiles.columns.has(found.column));
    const used = has ? wanted : app.tiles.columns.has("rgb") && wanted === "auto" ? "rgb" : "height";
    if (select.value !== used) select.value = used;
    setMode(used);
    app.colour = used;
    draw(legend, used, app);
  };
  settings.follow("colour", refresh);
  app.refreshColours = refresh;
  app.nextColour = () => {
    const possible = [...select.options].filter((option) => !option.disabled);
    const at = possible.findIndex((option) => option.value === select.value);
    settings.set("colour", possible[(at + 1) % possible.length].value);
  };
}

function draw(legend, mode, app) {
  legend.replaceChildren();
  if (gradients[mode]) {
    const ramp = document.createElement("div");
    ramp.className = "ramp";
    ramp.style.background = gradients[mode];
    const ends = document.createElement("div");
    ends.className = "ends";
    const range = mode === "height" ? shared.uHeight.value : shared.uIntensity.value;
    const lift = mode === "height" ? app.origin?.[2] ?? 0 : 0;
    const unit = mode === "height" ? " m" : "";
    for (const value of range.toArray()) {
      const end = document.createElement("span");
      end.textContent = `${mode === "height" ? (Math.round(10 * (value + lift)) / 10 + 0).toFixed(1) : Number(value.toPrecision(4))}${unit}`;
      ends.append(end);
    }
    legend.append(ramp, ends);
  }
  const entries = mode === "verdict"
    ? Object.entries(VERDICTS).map(([name, rgb]) => [name, `rgb(${rgb.join(" ")})`])
    : mode === "scan" ? (app.scene?.sources ?? []).slice(0, 12).map((name, k) => [name.split("/").at(-1), scanColour(k)])
      : mode === "classification" ? CLASSES.map(([name, k]) => [name, classColour(k)]) : [];
  if (!entries.length) return;
  const list = document.createElement("ul");
  list.className = "legend";
  for (const [text, colour] of entries) {
    const item = document.createElement("li");
    const patch = document.createElement("i");
    patch.style.background = colour;
    item.append(patch, text);
    list.append(item);
  }
  legend.append(list);
}

const CLASSES = [["unclassified", 1], ["ground", 2], ["low vegetation", 3], ["high vegetation", 5], ["building", 6], ["water", 9]];
function classColour(k) {
  return `rgb(${[...textures.classification.image.data.slice(4 * k, 4 * k + 3)].join(" ")})`;
}
