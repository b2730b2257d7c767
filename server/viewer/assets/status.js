// The line at the foot of the page, and the messages about the server and the user.

import { clear, notify } from "./notices.js";

const element = (name) => document.getElementById(name);
const SPOKEN = {
  clear: "clear", stopped: "stopped", contact: "in contact", unknown: "unknown", none: "no user",
};

/** Return the word for a state: its verdict, or that something stopped the motion. */
export function verdictOf(state) {
  if (state.verdict === 2 || state.unknown) return "unknown";
  if (state.verdict === 1) return "contact";
  return state.touched.some((each) => !each.unloaded && !each.unknown) ? "stopped" : "clear";
}

export function showVerdict(verdict) {
  const badge = element("verdict");
  if (badge.dataset.verdict === verdict) return;
  badge.dataset.verdict = verdict;
  badge.textContent = SPOKEN[verdict];
}

/** Show the figures of the last second. */
export function showFigures({ points, fps, roundTrip, frameSeconds, place }) {
  element("status-points").textContent = points.toLocaleString("en");
  element("status-fps").textContent = fps.toFixed(0);
  element("status-trip").textContent = roundTrip === null ? "–" : `${(roundTrip * 1e3).toFixed(1)} ms`;
  element("status-frame").textContent = frameSeconds === null ? "–" : `${(frameSeconds * 1e3).toFixed(2)} ms`;
  element("status-place").textContent = place ? place.map((value) => value.toFixed(2)).join(" ") : "–";
}

/** Show what the process says about the server. before: the state before this one. */
export function showServer({ state, message, endpoint }, before) {
  if (state === "searching") {
    notify("server", "No server yet", message || `Looking for one at ${endpoint}.`, "warn");
  } else if (state === "lost") {
    notify("server", "The server is lost",
      `You stay where you are, and continue when it returns. ${message}`, "bad");
  } else if (before === "lost") {
    notify("server", "The server is back", "", "", 4);
  } else {
    clear("server");
  }
  if (state === "connected" && message) notify("scene", "About this scene", message, "warn");
  else clear("scene");
}

/** Show whether the process of the viewer is connected. */
export function showProcess(connected, reason) {
  if (connected) clear("process");
  else {
    notify("process", "The viewer has ended",
      reason || "Start it again with: solidcloud view. This page continues when it is back.", "bad");
  }
}

/** Show what a state says about data that is not there. */
export function showState(state) {
  const unknown = state.unknown || state.touched.some((each) => each.unknown && !each.unloaded);
  if (unknown) {
    notify("unknown", "Unknown region",
      "The scan cannot be examined here, so the way is not known to be clear.", "unknown", 1.5);
  }
  if (state.unloaded > 0) {
    notify("loading", "Loading the way ahead", "The server reads the voxels in front of the user.", "", 0.8);
  }
}

/** Say that the user is not there yet, or that nothing of the scan is in view.
 *
 * waits: whether the server has no user of this page yet, and has said nothing about it.  sees: whether
 * points of the scan are in the picture; null while there is no user.
 */
export function showSight({ waits, sees }) {
  if (waits) notify("standing", "Looking for a place to stand", "You can walk in a moment.");
  else clear("standing");
  if (sees === false) {
    notify("sight", "Nothing of the scan is in view", "Turn with Q and E or by dragging; H goes back to the start.");
  } else clear("sight");
}
