// Panels of the settings. A panel is a module that calls `panel` once; index.js imports them in order.

import { settings } from "../settings.js";

const area = document.getElementById("panel");
let serial = 0;

/** Add a panel. title: its heading.  Returns its element. */
export function panel(title) {
  const section = document.createElement("section");
  const heading = document.createElement("h2");
  heading.textContent = title;
  heading.id = `panel-${serial += 1}`;
  section.setAttribute("aria-labelledby", heading.id);
  section.append(heading);
  area.append(section);
  return section;
}

function labelled(section, text, input, ...more) {
  const label = document.createElement("label");
  const span = document.createElement("span");
  span.textContent = text;
  // Without the key and the value that the label shows too.
  input.setAttribute("aria-label", text);
  label.append(span, input, ...more);
  section.append(label);
  return input;
}

/** Add a switch of a setting. key: the key that toggles it, as shown. */
export function toggle(section, name, text, key = "") {
  const input = document.createElement("input");
  input.type = "checkbox";
  input.name = name;
  const more = [];
  if (key) {
    const hint = document.createElement("kbd");
    hint.textContent = key;
    more.push(hint);
    input.setAttribute("aria-keyshortcuts", key);
  }
  input.addEventListener("change", () => settings.set(name, input.checked));
  settings.follow(name, (value) => { input.checked = value; });
  return labelled(section, text, input, ...more);
}

/** Add a slider of a setting. shown: returns the text of a value. */
export function slider(section, name, text, { min, max, step }, shown) {
  const input = document.createElement("input");
  Object.assign(input, { type: "range", min, max, step, name });
  const output = document.createElement("output");
  input.addEventListener("input", () => settings.set(name, Number(input.value)));
  settings.follow(name, (value) => {
    input.value = value;
    output.textContent = shown(value);
    input.setAttribute("aria-valuetext", shown(value));
  });
  return labelled(section, text, input, output);
}

/** Add a list of options [value, text]. Returns its element. */
export function choice(section, text, options, changed) {
  const select = document.createElement("select");
  select.setAttribute("aria-label", text);
  for (const [value, title] of options) select.append(new Option(title, value));
  select.addEventListener("change", () => changed(select.value));
  section.append(select);
  return select;
}

/** Add a row of buttons [text, function]. */
export function buttons(section, ...made) {
  const row = document.createElement("div");
  row.className = "buttons";
  for (const [text, pressed] of made) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.addEventListener("click", () => pressed(button));
    row.append(button);
  }
  section.append(row);
}
