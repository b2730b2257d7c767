// The page: a form for the pose, and the verdict.

import { Client } from "./client.js";
import { columnPoints, uprightPose } from "./wire.js";

const HEIGHT = 1.75, RADIUS = 0.25;

/** @param {string} id @returns {HTMLInputElement} */
const input = (id) => /** @type {HTMLInputElement} */ (document.getElementById(id));
const said = /** @type {HTMLElement} */ (document.getElementById("said"));
const verdict = /** @type {HTMLElement} */ (document.getElementById("verdict"));
const ask = /** @type {HTMLFieldSetElement} */ (document.getElementById("ask"));

/** @type {Client | null} */
let client = null;

/** @param {string} name @param {string} text */
function show(name, text) {
  verdict.dataset.verdict = name;
  verdict.textContent = name;
  said.textContent = text;
}

/** Do something, and show why it failed. @param {() => Promise<void>} work */
async function attempt(work) {
  try {
    await work();
  } catch (error) {
    show("unknown", error instanceof Error ? error.message : String(error));
  }
}

async function connect() {
  ask.disabled = true;
  await client?.close();
  client = null;
  show("unknown", "Connecting …");
  const opened = await Client.open(input("bridge").value, input("scene").value);
  const info = await opened.info();
  if (info === null || (await opened.addFigure(columnPoints(HEIGHT, RADIUS), RADIUS)) === null) {
    await opened.close();
    show("unknown", `No server replies for the scene ${input("scene").value}.`);
    return;
  }
  client = opened;
  ask.disabled = false;
  const [low, high] = info.bounds.map((corner) => corner.map((value) => value?.toFixed(2) ?? "?").join(", "));
  show("unknown", `${info.scene}: ${info.points.toLocaleString("en")} points from (${low}) to (${high}). `
    + "This page has no key of the server: replies are accepted unverified.");
}

async function collide() {
  if (!client) return;
  const place = ["x", "y", "z"].map((name) => input(name).valueAsNumber);
  const answers = await client.collide([uprightPose(place, input("turn").valueAsNumber)]);
  if (answers === null) {
    show("unknown", "No server replies.");
    return;
  }
  const notes = [
    `${answers.nodeVisits[0]} node visits, ${answers.pointTests[0]} point tests`,
    `${(1e3 * answers.engineSeconds).toFixed(2)} ms in the server`,
    ...(answers.outside[0] ? ["the figure reaches beyond the scan"] : []),
    ...(answers.voxelsMissing[0] ? [`${answers.voxelsMissing[0]} voxels could not be examined`] : []),
    ...answers.faults,
  ];
  show(answers.verdict[0] ?? "unknown", notes.join("; "));
}

/** @param {string} id @param {() => Promise<void>} work */
function submitted(id, work) {
  document.getElementById(id)?.addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(work);
  });
}

submitted("connection", connect);
submitted("question", collide);
