// Panel: where the user is, as a link.

import { buttons, panel } from "./registry.js";

export function addPlacePanel(app) {
  const section = panel("Place");
  buttons(section,
    ["Back to start", () => app.restart(null)],
    ["Copy link", async (button) => {
      const link = app.placeLink();
      if (!link) return;
      try {
        await navigator.clipboard.writeText(link);
        button.textContent = "Copied";
      } catch {
        // Without the right to the clipboard, the address bar has the link.
        history.replaceState(null, "", link);
        button.textContent = "In the address";
      }
      setTimeout(() => { button.textContent = "Copy link"; }, 1600);
    }]);
}
