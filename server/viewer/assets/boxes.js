// Boxes of the voxels near the user, coloured by whether they are in the server's memory.

import {
  BufferAttribute, BufferGeometry, LineBasicMaterial, LineSegments,
} from "./vendor/three.module.min.js";

export const COLOURS = {
  loaded: [0.37, 0.83, 0.77], prefetched: [0.45, 0.66, 1], wasted: [1, 0.42, 0.37], evicted: [0.3, 0.38, 0.5],
};
// Nearest voxels that are drawn.
const MOST = 600;
// Lines are drawn beside the points of walls, and above those of floors, by this much [m].
const OUT = 0.03;
// Pairs of a box's corners; bit k of a corner: the high end along axis k.
const EDGES = [0, 1, 2, 3, 4, 5, 6, 7, 0, 2, 1, 3, 4, 6, 5, 7, 0, 4, 1, 5, 2, 6, 3, 7];

export class Boxes {
  /** group: object for the lines. */
  constructor(group) {
    this.object = new LineSegments(
      new BufferGeometry(), new LineBasicMaterial({ vertexColors: true, transparent: true, opacity: 0.75 }));
    this.object.frustumCulled = false;
    this.object.visible = false;
    group.add(this.object);
    this.version = -1;
    const size = MOST * EDGES.length * 3;
    for (const name of ["position", "color"]) {
      this.object.geometry.setAttribute(name, new BufferAttribute(new Float32Array(size), 3));
    }
  }

  /** Draw the boxes of voxels, if they are wanted and have changed. */
  update(tiles, focus, on) {
    this.object.visible = on;
    if (!on || this.version === tiles.version) return;
    this.version = tiles.version;
    const near = [...tiles.voxels.values()]
      .map((voxel) => ({ voxel, away: voxel.box.distanceToPoint(focus) }))
      .sort((one, other) => one.away - other.away)
      .slice(0, MOST);
    const { position, color } = this.object.geometry.attributes;
    let at = 0;
    // Those in memory last: where boxes meet, their lines are seen.
    near.sort((one, other) => one.voxel.resident - other.voxel.resident);
    for (const { voxel: { box, state } } of near) {
      for (const corner of EDGES) {
        position.array[at] = corner & 1 ? box.max.x + OUT : box.min.x - OUT;
        position.array[at + 1] = corner & 2 ? box.max.y + OUT : box.min.y - OUT;
        position.array[at + 2] = corner & 4 ? box.max.z + OUT : box.min.z + OUT;
        color.array.set(COLOURS[state], at);
        at += 3;
      }
    }
    position.needsUpdate = color.needsUpdate = true;
    this.object.geometry.setDrawRange(0, at / 3);
  }
}
