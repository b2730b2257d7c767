// Panel: the dial of accuracy. What a tolerance saves at the user's pose, and what it leaves open.

import { settings } from "../settings.js";
import { foldingPanel, note } from "./folding.js";
import { slider } from "./registry.js";

// Interval of the questions, and when an answer counts as lost [ms].
const ASK_MS = 250, LOST_MS = 4000;
const VERDICTS = ["clear", "contact", "unknown"];
const TITLES = { collide: "Does it touch?", distance: "How far away is the scan?" };
const centimetres = (metres) => (metres === null ? null : `${(100 * metres).toFixed(1)}`);

export function addAccuracyPanel(app) {
  const { body, seen } = foldingPanel("Dial of accuracy",
    "The same question about your user's pose, answered exactly and within a tolerance, side by side.", "openAccuracy");
  slider(body, "tolerance", "Tolerance", { min: 0, max: 10, step: 0.5 }, (value) => `${value.toFixed(1)} cm`);
  const table = document.createElement("table");
  body.append(table);
  const saved = note(body, "No user yet.");
  note(body, "A tolerance may report a contact early, never late. Frames do not follow this dial: a session has no tolerance of its own. The scene file's tolerance applies to their sweeps.");
  let asked = "", time = -Infinity, waiting = false, found = null;
  app.readable.measured = () => found;

  app.on("measured", (message) => {
    waiting = false;
    found = message;
    show();
  });

  const ask = () => {
    const now = performance.now();
    if (!seen() || !app.state || (waiting && now - time < LOST_MS)) return;
    const wanted = `${settings.get("tolerance")}|${app.state.pose}`;
    if (wanted === asked) return;
    asked = wanted;
    time = now;
    waiting = true;
    app.link.send({ type: "measure", tolerance: settings.get("tolerance") / 100 });
  };
  setInterval(ask, ASK_MS);
  settings.follow("tolerance", ask);
  app.whenSeen(seen, ask);

  function show() {
    const { tolerance, answers, reach } = found;
    const head = row("th", "", "exact", `within ${(100 * tolerance).toFixed(1)} cm`);
    const rows = Object.entries(answers).flatMap(([question, { exact, tolerant }]) => [
      group(TITLES[question]),
      row("td", "verdict", ...[exact, tolerant].map((each) => verdict(each, question))),
      ...(question === "distance" ? [row("td", "distance [cm]", ...[exact, tolerant].map((each) => interval(each, reach)))] : []),
      row("td", "node visits", ...[exact, tolerant].map((each) => each.visits.toLocaleString("en"))),
      row("td", "point tests", ...[exact, tolerant].map((each) => each.tests.toLocaleString("en"))),
      row("td", "time [µs]", ...[exact, tolerant].map((each) => Math.round(1e6 * each.seconds).toLocaleString("en"))),
    ]);
    table.replaceChildren(head, ...rows);
    const sum = (kind, name) => Object.values(answers).reduce((all, each) => all + each[kind][name], 0);
    const [visits, seconds] = [["visits", "fewer"], ["seconds", "less"]].map(([name, word]) => (
      less(sum("tolerant", name), sum("exact", name), word)));
    saved.textContent = tolerance > 0
      ? `With this tolerance both answers together take ${visits} node visits and ${seconds} time.`
      : "At tolerance 0 both answers are exact.";
  }
}

/** Return how one number compares to another, as text. */
function less(value, than, word) {
  const share = than ? Math.round(100 * (1 - value / than)) : 0;
  return share >= 0 ? `${share} % ${word}` : `${-share} % more`;
}

/** Return the word for a verdict. Only a contact of `collide` may be early. */
function verdict({ verdict: number, sure }, question) {
  return question === "collide" && number === 1 && !sure ? "contact, perhaps early" : VERDICTS[number];
}

function interval({ lower, upper, sure }, reach) {
  if (upper === null) return `over ${centimetres(lower ?? reach)}`;
  if (lower === null) return `at most ${centimetres(upper)}`;
  return centimetres(lower) === centimetres(upper) && sure ? centimetres(upper) : `${centimetres(lower)} to ${centimetres(upper)}`;
}

function row(kind, title, ...texts) {
  const made = document.createElement("tr");
  const first = document.createElement("th");
  first.textContent = title;
  if (title) first.scope = "row";
  made.append(first, ...texts.map((text) => {
    const cell = document.createElement(kind);
    cell.textContent = text;
    if (kind === "th") cell.scope = "col";
    return cell;
  }));
  return made;
}

function group(title) {
  const made = document.createElement("tr"), cell = document.createElement("th");
  made.className = "group";
  Object.assign(cell, { colSpan: 3, scope: "rowgroup", textContent: title });
  made.append(cell);
  return made;
}
