// The panels, in the order in which the page shows them.

import { addAccuracyPanel } from "./accuracy.js";
import { addClashPanel } from "./clash.js";
import { addColourPanel } from "./colour.js";
import { addEffectsPanel } from "./effects.js";
import { instrumentsToggle } from "./folding.js";
import { addHelpPanel } from "./help.js";
import { addHierarchyPanel } from "./hierarchy.js";
import { addPlacePanel } from "./place.js";
import { addPlotsPanel } from "./plots.js";
import { hintAtMore } from "./scrolling.js";
import { addQualityPanel, addShowPanel } from "./show.js";
import { addWalkPanel } from "./walk.js";

export function addPanels(app) {
  const settings = [
    addColourPanel, addShowPanel, addQualityPanel, addPlacePanel, addWalkPanel, addClashPanel, addHelpPanel,
  ];
  for (const add of settings) add(app);
  // What is going on, beside the settings.
  instrumentsToggle(app);
  for (const add of [addPlotsPanel, addEffectsPanel, addAccuracyPanel, addHierarchyPanel]) add(app);
  for (const name of ["panel", "instruments"]) hintAtMore(document.getElementById(name));
}
