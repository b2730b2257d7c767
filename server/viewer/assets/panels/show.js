// Panel: what is shown besides the scan, and with how many points.

import { COLOURS } from "../boxes.js";
import { panel, slider, toggle } from "./registry.js";

export function addShowPanel() {
  const section = panel("Show");
  toggle(section, "firstPerson", "First person", "V");
  toggle(section, "contacts", "Contacts and normals", "N");
  toggle(section, "clearance", "Line to the nearest point", "L");
  toggle(section, "boxes", "Voxels in memory", "B");
  const list = document.createElement("ul");
  list.className = "legend two";
  const entries = [["in memory", "loaded"], ["read ahead", "prefetched"], ["read in vain", "wasted"], ["on disk", "evicted"]];
  for (const [text, state] of entries) {
    const item = document.createElement("li");
    const patch = document.createElement("i");
    patch.style.background = `rgb(${COLOURS[state].map((part) => Math.round(255 * part)).join(" ")})`;
    item.append(patch, text);
    list.append(item);
  }
  section.append(list);
  const count = document.createElement("p");
  count.id = "boxes-count";
  section.append(count);
}

export function addQualityPanel() {
  const section = panel("Quality");
  toggle(section, "shading", "Shading by depth");
  slider(section, "budget", "Points", { min: 0.1, max: 4, step: 0.1 }, (value) => `${value.toFixed(1)} M`);
}
