// Panel: the keys.

import { panel } from "./registry.js";

const KEYS = [
  [["W", "A", "S", "D"], "walk; also the arrow keys"],
  [["Shift"], "run"],
  [["Q", "E"], "turn; or drag the view"],
  [["V"], "first or third person"],
  [["C"], "next colour"],
  [["G"], "what is going on: plots, effects, accuracy, hierarchy"],
  [[",", "."], "previous or next clash; Esc: back to the user"],
  [["H"], "back to the start"],
  [["T"], "record the walk, or stop"],
  [["P"], "play the walk, or pause"],
  [["R", "F"], "up and down, where nothing holds you to the ground"],
];

const TOUCH = [
  [["stick"], "walk"],
  [["drag"], "look"],
  [["pinch"], "nearer, farther"],
];

export function addHelpPanel() {
  const section = panel("Keys");
  const list = document.createElement("dl");
  list.className = "keys";
  const touched = matchMedia("(pointer: coarse)").matches;
  for (const [keys, text] of touched ? [...TOUCH, ...KEYS] : KEYS) {
    const term = document.createElement("dt");
    for (const key of keys) {
      const shown = document.createElement("kbd");
      shown.textContent = key;
      term.append(shown, " ");
    }
    const meaning = document.createElement("dd");
    meaning.textContent = text;
    list.append(term, meaning);
  }
  section.append(list);
}
