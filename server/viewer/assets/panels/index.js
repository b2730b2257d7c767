// The panels, in the order in which the page shows them.

import { addColourPanel } from "./colour.js";
import { addHelpPanel } from "./help.js";
import { addPlacePanel } from "./place.js";
import { addQualityPanel, addShowPanel } from "./show.js";
import { addWalkPanel } from "./walk.js";

export function addPanels(app) {
  for (const add of [addColourPanel, addShowPanel, addQualityPanel, addPlacePanel, addWalkPanel, addHelpPanel]) add(app);
}
