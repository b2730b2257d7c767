// The panels, in the order in which the page shows them.

import { addClashPanel } from "./clash.js";
import { addColourPanel } from "./colour.js";
import { addHelpPanel } from "./help.js";
import { addPlacePanel } from "./place.js";
import { addQualityPanel, addShowPanel } from "./show.js";

export function addPanels(app) {
  for (const add of [addColourPanel, addShowPanel, addQualityPanel, addPlacePanel, addClashPanel, addHelpPanel]) add(app);
}
