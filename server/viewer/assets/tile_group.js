// The objects of the tiles, and their spheres in one array.
//
// A town of 10^8 points has thousands of tiles, most of them far and with some dozens of points. To look up
// each one in memory for each picture took as long as to draw their points.

import { Group, Sphere } from "./vendor/three.module.min.js";

const sphere = new Sphere();

export class TileGroup extends Group {
  constructor() {
    super();
    this.isTileGroup = true;
    this.matrixAutoUpdate = false;
    this.changes = 0;
    this.placed = -1;
    this.listed = -1;
    this.spheres = new Float64Array(0);
  }

  /** Note that tiles came or went, or have other points. */
  changed() {
    this.changes += 1;
  }

  updateMatrixWorld(force) {
    if (!force && this.placed === this.changes) return;
    this.placed = this.changes;
    super.updateMatrixWorld(force);
  }

  /** Return the spheres of `children`, (n, 4) as one array: middle and radius, in the page's frame. */
  list() {
    if (this.listed === this.changes) return this.spheres;
    const { children } = this;
    if (this.spheres.length < 4 * children.length) this.spheres = new Float64Array(8 * children.length);
    children.forEach(({ geometry, matrixWorld }, k) => {
      const { center, radius } = sphere.copy(geometry.boundingSphere).applyMatrix4(matrixWorld);
      this.spheres.set([center.x, center.y, center.z, radius], 4 * k);
    });
    this.listed = this.changes;
    return this.spheres;
  }
}
