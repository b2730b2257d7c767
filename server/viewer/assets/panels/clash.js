// Panel: clash check along a path.

import { CLASSES } from "../clash/clearance.js";
import { settings } from "../settings.js";
import { buttons, panel, slider } from "./registry.js";

const metres = (value) => value.toFixed(2).replace(/^-(?=0\.00$)/, "");
const centimetres = (value) => `${(100 * value).toFixed(1)} cm`;
const count = (number, one) => `${number.toLocaleString("en")} ${number === 1 ? one : `${one}s`}`;

function make(kind, properties = {}, ...children) {
  const element = Object.assign(document.createElement(kind), properties);
  element.append(...children);
  return element;
}

export function addClashPanel(app) {
  const { clash } = app;
  const section = panel("Clash check");
  section.append(make("p", { textContent: "Finds where the avatar touches the scan along a path, at its poses and on the motions between them. Depth is how far two of their spheres overlap." }));
  const input = make("input", { type: "file", accept: ".csv,.tum,.txt" });
  input.addEventListener("change", async () => {
    const [file] = input.files;
    // The same file can be chosen again, after a change.
    if (file) await clash.load(file);
    input.value = "";
  });
  section.append(make("label", { className: "file" }, make("span", { textContent: "Load a path, CSV or TUM…" }), input));
  const bar = make("progress", { max: 1 });
  const cancel = make("button", { type: "button", textContent: "Cancel" });
  cancel.addEventListener("click", () => clash.cancel());
  const running = make("div", { className: "running" }, bar, cancel);
  const message = make("p", { id: "clash-message" });
  message.setAttribute("role", "status");
  section.append(running, message);

  const found = make("div");
  section.append(found);
  // The effect `ground` keeps the feet 3 cm above the floor: a larger default calls every step near.
  slider(found, "near", "Near", { min: 0.01, max: 1, step: 0.01 }, (value) => `${value.toFixed(2)} m`);
  const legend = make("ul", { className: "legend" });
  const list = make("ol", { id: "clash-list" });
  list.setAttribute("aria-label", "Clashes, deepest first");
  found.append(legend, list);
  buttons(found, ["Previous  ,", () => clash.step(-1)], ["Next  .", () => clash.step(1)]);
  const back = make("button", { type: "button", textContent: "Back to the user  Esc" });
  back.addEventListener("click", () => clash.leave());
  found.append(back);
  const save = make("p", { textContent: "Save" });
  found.append(save);
  buttons(found, ["CSV", () => clash.save("csv")], ["JSON", () => clash.save("json")], ["BCF 2.1", () => clash.save("bcf")]);
  found.lastChild.classList.add("three");
  const cut = make("p", { id: "clash-cut" });
  found.append(cut);
  buttons(section, ["Save the view as PNG", () => clash.savePicture()]);
  section.lastChild.classList.add("one");

  settings.follow("near", (value) => {
    clash.line.colour(value);
    clash.changed();
  });
  let listed = null, begun = "";
  clash.follow(() => {
    const { state, result, line } = clash;
    running.hidden = state !== "running" && state !== "saving";
    if (state === "running" && begun !== state) section.scrollIntoView({ block: "start" });
    begun = state;
    bar.value = clash.done;
    bar.setAttribute("aria-label", state === "saving" ? "Drawing the pictures of the file" : "Checking the path");
    message.textContent = text(clash);
    message.className = clash.message ? "bad" : "";
    found.hidden = !line.verdicts.length;
    drawLegend(legend, line, settings.get("near"));
    if (result !== listed) {
      listed = result;
      drawList(list, clash);
    }
    for (const [k, item] of [...list.querySelectorAll("li[data-number]")].entries()) {
      const own = k + 1 === clash.selected;
      const button = item.firstChild;
      if (own === (button.getAttribute("aria-current") === "true")) continue;
      button.setAttribute("aria-current", String(own));
      item.lastChild.hidden = !own;
      if (own) item.scrollIntoView({ block: "nearest" });
    }
    cut.hidden = !result || result.total <= result.topics;
    if (!cut.hidden) cut.textContent = `BCF has the ${result.topics} deepest of the ${result.total.toLocaleString("en")} clashes, because each has a picture; CSV and JSON have all.`;
    back.hidden = !app.rig.watched;
    for (const button of found.querySelectorAll(".buttons button")) button.disabled = !result || state === "saving";
  });
}

function text({ state, name, message, done, result, line }) {
  if (message) return message;
  if (state === "running") return `${name}: ${Math.round(100 * done)} % checked`;
  if (state === "saving") return `BCF: ${Math.round(100 * done)} % of the pictures drawn`;
  if (!result) return "";
  const { counts, motions, between, poses, total, clearance, reach, complete, faults } = result;
  const parts = [total ? `${count(total, "clash").replace("clashs", "clashes")}.` : "No clash."];
  parts.push(`${counts.contact.toLocaleString("en")} of ${count(poses, "pose")} in contact`);
  if (counts.unknown) parts.push(`, ${counts.unknown.toLocaleString("en")} unknown`);
  if (between) parts.push(`; ${count(between, "clash").replace("clashs", "clashes")} between poses`);
  if (motions.unknown) parts.push(`; ${count(motions.unknown, "motion")} between poses unknown`);
  parts.push(".");
  if (!total) parts.push(clearance === null ? ` Nothing within ${reach} m.` : ` Clearance at least ${clearance.toFixed(3)} m.`);
  if (!complete) parts.push(" Cancelled: the rest was not examined.");
  if (faults.length) parts.push(` Unknown because: ${faults.join("; ")}`);
  return `${name}: ${parts[0]} ${parts.slice(1).join("")}`;
}

function drawLegend(legend, line, near) {
  const entries = CLASSES.map(({ colour, text: words }, k) => ({ colour, words: words(near), number: line.counts[k] }));
  const shown = entries.filter(({ number }, k) => k < 4 || number);
  const now = JSON.stringify(shown);
  if (legend.dataset.now === now) return;
  legend.dataset.now = now;
  legend.replaceChildren(...shown.map(({ colour, words, number }) => {
    const patch = make("i");
    patch.style.background = `rgb(${colour.join(" ")})`;
    return make("li", {}, patch, words, make("b", { textContent: number.toLocaleString("en") }));
  }));
}

function drawList(list, clash) {
  const { result } = clash;
  list.replaceChildren(...(result?.clashes ?? []).map((each) => {
    const [from, to] = each.poses, [begin, end] = each.times;
    const which = each.fraction !== null ? `between pose ${from} and ${to}` : from === to ? `pose ${from}` : `poses ${from} to ${to}`;
    const when = begin === null ? "" : ` · ${begin.toFixed(2)}${from === to ? "" : ` to ${end.toFixed(2)}`} s`;
    const button = make("button", { type: "button" },
      make("strong", { textContent: `${each.clash}. ${centimetres(each.depth)} deep` }),
      make("span", { textContent: count(each.contacts, "contact") }),
      make("span", { textContent: `${which}${when}` }),
      make("span", { textContent: `at ${each.place.map(metres).join(" ")}` }));
    button.setAttribute("aria-current", "false");
    button.addEventListener("click", () => clash.show(each.clash));
    const clusters = make("ul", { hidden: true }, ...each.clusters.slice(0, 8).map((cluster) => make("li", {
      textContent: `${centimetres(cluster.depth)} · ${count(cluster.contacts, "contact")} · at ${cluster.place.map(metres).join(" ")}`,
    })));
    if (each.clusters.length > 8) clusters.append(make("li", { textContent: `${each.clusters.length - 8} more clusters` }));
    clusters.setAttribute("aria-label", "Clusters of contacts");
    const item = make("li", {}, button, clusters);
    item.dataset.number = each.clash;
    return item;
  }));
  if (result && result.total > result.clashes.length) {
    list.append(make("li", { textContent: `${result.total - result.clashes.length} more in the saved files` }));
  }
}
