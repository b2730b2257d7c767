// Records the walk of the own user: the server's poses, in the world, with the times of their commands.

import { quaternion } from "./pose_text.js";

// An hour at 30 states a second.
const MOST = 108_000;
// States come 30 times a second. Over a longer pause the user stood where it was last seen [s].
const PAUSE = 0.25, STEP = 1 / 30;

export class Recorder {
  /** full: called when the recording has its greatest length. */
  constructor(full) {
    this.full = full;
    this.on = false;
    this.samples = [];
  }

  start() {
    this.on = true;
    this.samples = [];
    this.first = null;
  }

  /** Stop, and return the walk. */
  stop() {
    this.on = false;
    return this.samples;
  }

  /** Return the length of what is recorded [s]. */
  get seconds() {
    return this.samples.at(-1)?.time ?? 0;
  }

  /** Take a state of the user. origin, axes: of the page's frame, world. */
  take({ time, pose }, origin, axes) {
    if (!this.on) return;
    this.first ??= time;
    const last = this.samples.at(-1);
    const seconds = time - this.first;
    // Two states may be of one command.
    if (last && seconds <= last.time) return;
    if (last && seconds - last.time > PAUSE) this.samples.push({ ...last, time: seconds - STEP });
    const world = (x, y, z) => [0, 1, 2].map((k) => x * axes[0][k] + y * axes[1][k] + z * axes[2][k]);
    const column = (k) => world(...pose.slice(0, 3).map((row) => row[k]));
    const [right, ahead, up, place] = [0, 1, 2, 3].map(column);
    this.samples.push({
      time: seconds,
      place: place.map((value, k) => origin[k] + value),
      turn: quaternion([0, 1, 2].map((k) => [right[k], ahead[k], up[k]])),
    });
    if (this.samples.length >= MOST) this.full();
  }
}
