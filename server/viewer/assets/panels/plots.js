// Panel: the last minute of the server, as charts.

import { Chart } from "../chart.js";
import { foldingPanel, note } from "./folding.js";

// Okabe and Ito's colours, which people with any kind of colour vision tell apart.
const COLOURS = {
  stop: "#56b4e9", sweep: "#0072b2", slide: "#009e73", step: "#f0e442", ground: "#b8864e", proximity: "#e69f00",
  contacts: "#d55e00", uncertainty: "#cc79a7", objects: "#9a8cff", crowd: "#c8ced6",
};
const KEPT = 64;
const MIB = 2 ** 20;
const milliseconds = (value) => `${value.toFixed(value < 10 ? 2 : 0)} ms`;
const rate = (value) => `${value < 10 ? Number(value.toFixed(1)) : Math.round(value)} /s`;
const bytes = (value) => (value < 1024 ? `${value.toFixed(value < 100 ? 1 : 0)} MiB` : `${(value / 1024).toFixed(2)} GiB`);

/** What a page has measured of its own user since the last sample. */
class Own {
  constructor() {
    this.clear();
  }

  clear() {
    Object.assign(this, { count: 0, trip: 0, worst: 0, frame: 0 });
  }

  take({ roundTrip, seconds }) {
    this.count += 1;
    this.trip += roundTrip;
    this.worst = Math.max(this.worst, roundTrip);
    this.frame += seconds;
  }

  /** Return the means [ms], and begin anew. */
  read() {
    const { count, trip, worst, frame } = this;
    this.clear();
    return count ? { trip: (1e3 * trip) / count, worst: 1e3 * worst, frame: (1e3 * frame) / count } : {};
  }
}

export function addPlotsPanel(app) {
  const { body, seen } = foldingPanel("Live plots",
    "What the server did in each of the last 60 seconds, and how long a frame of your user took.", "openPlots");
  const frames = new Chart(body, { title: "Frame time by effect, mean", unit: "ms", format: milliseconds });
  const trip = new Chart(body, {
    title: "Round trip of a motion command", unit: "ms", format: milliseconds,
    series: [
      { name: "worst", label: "worst", colour: "#e69f00", kind: "line" },
      { name: "trip", label: "mean", colour: "#56b4e9", kind: "line" },
    ],
  });
  const cache = new Chart(body, {
    title: "Voxels requested", unit: "per second", format: rate, logarithmic: true,
    series: [
      { name: "hits", label: "hits: in memory", colour: "#5fd3c4", kind: "line" },
      { name: "misses", label: "misses: had to be read", colour: "#ff6b5e", kind: "line" },
    ],
  });
  const ahead = new Chart(body, {
    title: "Voxels read ahead", unit: "per second", format: rate,
    series: [
      { name: "prefetched", label: "prefetched", colour: "#73a8ff", kind: "line" },
      { name: "wasted", label: "wasted: evicted unused", colour: "#ff6b5e", kind: "line" },
    ],
  });
  const memory = new Chart(body, {
    title: "Memory of the cache", unit: "MiB", format: bytes,
    series: [
      { name: "voxels", label: "voxels", colour: "#5fd3c4", kind: "area" },
      { name: "levels", label: "levels of detail", colour: "#8a7bd8", kind: "area" },
    ],
  });
  const text = note(body, "No statistics yet.");
  const charts = [frames, trip, cache, ahead, memory];
  const own = new Own();
  let samples = [], named = "", arrived = performance.now(), last = null;

  app.frameListeners.add((state) => own.take(state));
  app.on("statistics", (message) => {
    if (message.all) samples = [];
    for (const each of message.samples) {
      last = each;
      samples.push(flat(each, message.all ? {} : own.read()));
    }
    samples = samples.slice(-KEPT);
    arrived = performance.now();
    if (last) name();
    draw();
  });
  // A server that answers no more leaves a gap that grows.
  setInterval(() => {
    if (performance.now() - arrived > 1500) draw();
  }, 1000);
  app.readable.samples = () => samples;

  /** Use the effects that the scene runs, in their order, and the budget. */
  function name() {
    const { effects, memory: { budget, voxels, levels } } = last;
    // An axis up to a budget that is hardly used would show nothing.
    const near = voxels + levels > 0.1 * budget;
    const now = `${effects.map(([effect]) => effect)}${near}`;
    if (now === named) return;
    named = now;
    frames.setSeries([
      ...effects.map(([effect], k) => ({
        name: `effect ${effect}`, label: effect, kind: "area", colour: COLOURS[effect] ?? Object.values(COLOURS)[k % 10],
      })),
      { name: "frame", label: "whole frame, yours", colour: "#e6edf5", kind: "line" },
    ]);
    memory.setSeries([...memory.series.slice(0, 2), ...(near ? [{ name: "budget", label: "budget", colour: "#f2b84b", kind: "dash" }] : [])]);
  }

  function draw() {
    if (!seen()) return;
    const now = last ? last.time + Math.max(0, performance.now() - arrived - 200) / 1000 : 0;
    for (const chart of charts) chart.draw(samples, now);
    if (!last) return;
    const { totals, memory: { voxels, levels, budget, resident, total } } = last;
    const share = (100 * (voxels + levels)) / budget;
    text.textContent = `${resident.toLocaleString("en")} of ${total.toLocaleString("en")} voxels in memory; with levels of detail ${bytes((voxels + levels) / MIB)} of `
      + `the budget of ${bytes(budget / MIB)} (${share < 1 ? share.toFixed(2) : share.toFixed(0)} %). Since the server began: `
      + `${totals.hits.toLocaleString("en")} hits, ${totals.misses.toLocaleString("en")} misses, ${totals.prefetched.toLocaleString("en")} prefetched, `
      + `${totals.wasted.toLocaleString("en")} of them wasted, ${totals.evicted.toLocaleString("en")} evicted.`;
  }
  app.whenSeen(seen, draw);
}

/** Return a sample for charts. own: what the page has measured. */
function flat({ time, effects, rates, memory }, own) {
  return {
    time, ...own, ...rates,
    voxels: memory.voxels / MIB, levels: memory.levels / MIB, budget: memory.budget / MIB,
    ...Object.fromEntries(effects.map(([effect, seconds]) => [`effect ${effect}`, 1e3 * seconds])),
  };
}
