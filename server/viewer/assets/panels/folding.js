// Panels of "What is going on": each folds, and says in one sentence what it shows.

import { settings } from "../settings.js";

const area = document.getElementById("instruments");

/** Add a panel. title: its heading.  sentence: what it shows.  name: of the setting that keeps whether
 * it is open.  Returns its body, and a function that returns whether it is seen. */
export function foldingPanel(title, sentence, name) {
  const section = document.createElement("section");
  const heading = document.createElement("h2"), button = document.createElement("button");
  const about = document.createElement("p"), body = document.createElement("div");
  button.type = "button";
  button.textContent = title;
  body.id = `instrument-${name}`;
  heading.id = `${body.id}-title`;
  button.setAttribute("aria-controls", body.id);
  section.setAttribute("aria-labelledby", heading.id);
  about.className = "about";
  about.textContent = sentence;
  heading.append(button);
  section.append(heading, about, body);
  area.append(section);
  button.addEventListener("click", () => settings.toggle(name));
  settings.follow(name, (open) => {
    button.setAttribute("aria-expanded", String(open));
    body.hidden = about.hidden = !open;
  });
  return { body, seen: () => settings.get("instruments") && settings.get(name) };
}

/** Make the button that shows and hides all these panels; key G does the same. */
export function instrumentsToggle(app) {
  const button = document.getElementById("instruments-toggle");
  button.addEventListener("click", () => settings.toggle("instruments"));
  app.input.actions.KeyG = () => settings.toggle("instruments");
  // On a small screen they would cover the scan.
  const small = matchMedia("(max-width: 760px)");
  if (small.matches) settings.set("instruments", false);
  // And there is room for one column.
  for (const [name, other] of [["instruments", "panel"], ["panel", "instruments"]]) {
    settings.follow(name, (open) => { if (open && small.matches) settings.set(other, false); });
  }
  settings.follow("instruments", (open) => {
    area.hidden = !open;
    button.setAttribute("aria-expanded", String(open));
  });
}

/** Add a paragraph. */
export function note(body, text = "") {
  const made = document.createElement("p");
  made.textContent = text;
  body.append(made);
  return made;
}
