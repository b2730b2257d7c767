// Panel: the effects of the scene, their cost, and switches where the viewer may change them.

import { clear, notify } from "../notices.js";
import { foldingPanel, note } from "./folding.js";

export function addEffectsPanel(app) {
  const { body, seen } = foldingPanel("Effects",
    "What the server simulates in each frame of a user, in the order in which it runs, and what each costs.", "openEffects");
  const list = document.createElement("ul");
  list.className = "effects";
  body.append(list);
  const text = note(body, "No scene yet.");
  let rows = new Map(), effects = [], costs = new Map();
  app.readable.effects = () => effects.map(({ name, on }) => ({ name, on }));

  app.on("effects", (message) => {
    const same = JSON.stringify(effects) === JSON.stringify(message.effects);
    effects = message.effects;
    if (!same || !rows.size) build(message);
    if (app.switching && effects.every(({ name, on }) => on === app.switching.has(name))) {
      app.switching = null;
      clear("server");
      notify("effects", "The scene runs with these effects", effects.filter(({ on }) => on).map(({ name }) => name).join(", "), "", 5);
    }
    show();
  });
  // A refusal ends the attempt.
  app.problemListeners.add(() => {
    app.switching = null;
    show();
  });
  app.on("statistics", ({ samples }) => {
    const last = samples.at(-1);
    if (last) costs = new Map(last.effects.map(([name, seconds]) => [name, seconds]));
    if (seen()) show();
  });
  app.whenSeen(seen, show);

  function build({ switchable }) {
    rows = new Map();
    list.replaceChildren(...effects.map(({ name, meaning, needs }) => {
      const item = document.createElement("li"), label = document.createElement("label");
      const title = document.createElement("span"), cost = document.createElement("output");
      const about = document.createElement("p");
      title.textContent = name;
      about.textContent = meaning + (needs.length ? ` Requires ${needs.join(" and ")}.` : "");
      const input = document.createElement("input");
      Object.assign(input, { type: "checkbox", name: `effect-${name}`, disabled: !switchable });
      input.setAttribute("aria-label", name);
      about.id = `effect-${name}-about`;
      input.setAttribute("aria-describedby", about.id);
      input.addEventListener("change", () => change(name, input.checked));
      label.append(input, title, cost);
      item.append(label, about);
      rows.set(name, { input, cost });
      return item;
    }));
    text.textContent = switchable
      ? "A switch opens the scene anew with other effects, for all users; it takes some seconds. Your scene file stays as it is."
      : "This viewer has not started the server, and a session cannot leave out effects: they are shown only. To change them, edit [[effects]] in the scene file and start the server again.";
  }

  /** Switch an effect, with those that it requires, or without those that require it. */
  function change(name, on) {
    const chosen = new Set([...rows].filter(([, { input }]) => input.checked).map(([each]) => each));
    const known = new Map(effects.map((each) => [each.name, each]));
    const add = (each) => {
      chosen.add(each);
      for (const needed of known.get(each)?.needs ?? []) add(needed);
    };
    if (on) add(name);
    for (let before = -1; before !== chosen.size;) {
      before = chosen.size;
      for (const each of chosen) {
        if (known.get(each).needs.some((needed) => !chosen.has(needed))) chosen.delete(each);
      }
    }
    app.switching = chosen;
    notify("server", "The scene is opened with other effects", "You continue where you are.", "warn");
    app.link.send({ type: "switch", names: [...chosen] });
    show();
  }

  function show() {
    for (const { name, on } of effects) {
      const { input, cost } = rows.get(name) ?? {};
      if (!input) continue;
      input.checked = app.switching ? app.switching.has(name) : on;
      const found = costs.get(name);
      if (!on) cost.textContent = "off";
      else if (found === undefined) cost.textContent = name === "through" ? "at start" : "–";
      else cost.textContent = `${(1e3 * found).toFixed(3)} ms`;
    }
  }
}
