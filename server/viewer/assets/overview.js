// The whole scan in few points: the first picture, and what lies beyond the tiles.

import { BufferAttribute, BufferGeometry, Points } from "./vendor/three.module.min.js";
import { pointsMaterial, shared } from "./points_material.js";

// Largest share of the screen that a point of the overview may cover is limited by its size [m].
const LARGEST = 0.12;
// Points that tiles now show are removed at most this often [ms].
const INTERVAL_MS = 300;
// Points that are drawn in any case.
const LEAST = 10e3;

/** Return the numbers below a count in an order that looks random and is always the same. */
function shuffled(count) {
  const found = Uint32Array.from({ length: count }, (_, k) => k);
  let state = 2012;
  for (let k = count - 1; k > 0; k -= 1) {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    const other = Math.floor((state / 2 ** 32) * (k + 1));
    [found[k], found[other]] = [found[other], found[k]];
  }
  return found;
}

export class Overview {
  /** group: object for the points. */
  constructor(group) {
    this.group = group;
    this.object = null;
    this.count = 0;
    this.covered = new Set();
  }

  clear() {
    if (!this.object) return;
    this.group.remove(this.object);
    this.object.geometry.dispose();
    this.object.material.dispose();
    this.object = null;
    this.count = 0;
    this.covered.clear();
  }

  get shown() {
    return this.object ? this.object.geometry.drawRange.count : 0;
  }

  /** Take the sample of the scene. columns: a set to which the names of its columns are added. */
  take({ total, radius, intensities, arrays }, columns) {
    this.clear();
    const { rows, array: places } = arrays.points;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(places, 3));
    for (const [name, { array, columns: width }] of Object.entries(arrays)) {
      if (name === "points") continue;
      geometry.setAttribute(name, new BufferAttribute(array, width, name === "rgb"));
      columns.add(name);
    }
    if (intensities) shared.uIntensity.value.set(...intensities);
    // In a random order, so that any beginning shows the whole scene.
    this.order = shuffled(rows);
    this.count = rows;
    geometry.setIndex(new BufferAttribute(this.order.slice(), 1));
    geometry.setDrawRange(0, Math.min(rows, LEAST));
    // A surface that n of N points show has a spacing larger by the root of N / n.
    const spacing = 2 * radius * Math.sqrt(Math.max(1, total / Math.max(1, rows)));
    this.size = Math.min(LARGEST, 1.6 * spacing);
    this.object = new Points(geometry, pointsMaterial(this.size));
    this.object.frustumCulled = false;
    this.group.add(this.object);
    this.places = places;
    this.hidden = new Uint8Array(rows);
    this.changed = false;
    this.time = 0;
    this.cells(places, rows);
  }

  /** Return the heights between which most points lie [m]. */
  heights() {
    const every = Math.max(1, Math.floor(this.hidden.length / 4000));
    const found = [];
    for (let row = 0; row < this.hidden.length; row += every) found.push(this.places[3 * row + 2]);
    found.sort((one, other) => one - other);
    const at = (share) => found[Math.round(share * (found.length - 1))];
    return [at(0.01), Math.max(at(0.01) + 0.5, at(0.97))];
  }

  /** Sort points into cells, to find those of a box quickly. */
  cells(places, rows) {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let k = 0; k < 3 * rows; k += 1) {
      low[k % 3] = Math.min(low[k % 3], places[k]);
      high[k % 3] = Math.max(high[k % 3], places[k]);
    }
    const edge = Math.max(0.5, ...high.map((value, axis) => (value - low[axis]) / 64));
    this.grid = { low, edge, rows: new Map() };
    for (let row = 0; row < rows; row += 1) {
      const name = [0, 1, 2].map((axis) => Math.floor((places[3 * row + axis] - low[axis]) / edge)).join();
      const cell = this.grid.rows.get(name);
      if (cell) cell.push(row);
      else this.grid.rows.set(name, [row]);
    }
  }

  /** Hide the points of a voxel whose tile is drawn. */
  cover(name, box) {
    if (!this.object || this.covered.has(name)) return;
    this.covered.add(name);
    const { low, edge, rows } = this.grid;
    const from = box.min.toArray().map((value, axis) => Math.floor((value - low[axis]) / edge));
    const to = box.max.toArray().map((value, axis) => Math.floor((value - low[axis]) / edge));
    for (let i = from[0]; i <= to[0]; i += 1) {
      for (let j = from[1]; j <= to[1]; j += 1) {
        for (let k = from[2]; k <= to[2]; k += 1) {
          for (const row of rows.get(`${i},${j},${k}`) ?? []) this.hide(row, box);
        }
      }
    }
  }

  hide(row, { min, max }) {
    const [x, y, z] = this.places.subarray(3 * row, 3 * row + 3);
    // The preview's coordinates are rounded.
    const more = 2e-3;
    if (x >= min.x - more && x <= max.x + more && y >= min.y - more && y <= max.y + more
      && z >= min.z - more && z <= max.z + more) {
      this.hidden[row] = 1;
      this.changed = true;
    }
  }

  /** Draw what is not hidden. size: factor of the points' size.  most: points.  now: [ms]. */
  update(size, most, now) {
    if (!this.object) return;
    this.object.material.uniforms.uSize.value = this.size * size;
    this.object.geometry.setDrawRange(0, Math.min(this.count, Math.max(LEAST, most)));
    if (!this.changed || now - this.time < INTERVAL_MS) return;
    this.changed = false;
    this.time = now;
    const { index } = this.object.geometry;
    let count = 0;
    for (const row of this.order) {
      if (!this.hidden[row]) index.array[count++] = row;
    }
    index.needsUpdate = true;
    this.count = count;
    this.object.geometry.setDrawRange(0, Math.min(count, Math.max(LEAST, most)));
    this.object.visible = count > 0;
  }
}
