// The scan around the user: which voxels are drawn in which detail, and the tiles that are missing.
//
// A voxel is drawn with the detail at which its points are about as far apart as the pixels that they
// cover. If that takes more points than the budget allows, all details become coarser alike. What is
// drawn stays until something better has arrived.

import {
  Box3, BufferAttribute, BufferGeometry, Frustum, Matrix4, Points, Sphere, Vector3,
} from "./vendor/three.module.min.js";
import { pointsMaterial, shared } from "./points_material.js";
import { TileGroup } from "./tile_group.js";

const MAX_DETAIL = 8;
// Most tiles that are asked for at once: the list is replaced as the view moves.
const MOST_WANTED = 48;
// Points kept on the graphics card, as a share of those that may be drawn.
const KEPT = 2.5;
// Spacing of drawn points at which the picture counts as complete [pixels].
const FINE = 1.4;
// Voxels behind the view are kept this much coarser: a turn shows them at once.
const BEHIND = 4;
// The list of voxels is asked for again after this way [m] or time [ms].
const LIST_WAY = 1, LIST_MS = 3000;
// A list of 4,096 voxels has 184 kB, and reaches far: it is asked for again later [ms of each voxel], and
// after a longer way. What is in memory is known meanwhile from messages of changes.
const LIST_VOXEL_MS = 6, LONG_LIST = 1000, LONG_LIST_WAY = 4;
// A list that has not arrived by then was refused [ms].
const LIST_LOST_MS = 15000;
// States of a voxel in a message of changes.
export const STATES = ["evicted", "loaded", "prefetched", "wasted"];

export class Tiles {
  /** group: object for the points.  send: sends a message.  drawn: called with each voxel whose tile arrives. */
  constructor(group, send, drawn) {
    this.group = new TileGroup();
    group.add(this.group);
    this.send = send;
    this.drawn = drawn;
    this.columns = new Set();
    this.pointSize = 1;
    this.clear();
  }

  /** Forget everything, for another scene or generation. */
  clear() {
    for (const voxel of this.voxels?.values() ?? []) this.drop(voxel);
    this.voxels = new Map();
    this.listed = { place: null, time: -Infinity, waiting: false };
    this.total = 0;
    this.resident = 0;
    this.residentBytes = 0;
    this.wasted = 0;
    this.shown = 0;
    this.radius = 0.01;
    this.sentWanted = "";
    this.failed = new Map();
    this.version = 0;
    this.changes = (this.changes ?? 0) + 1;
    this.columns.clear();
  }

  /** Take a list of voxels. */
  list({ arrays, total }) {
    this.listed.waiting = false;
    this.total = total;
    const { key, low, high, points, resident } = arrays;
    for (let row = 0; row < key.rows; row += 1) {
      const numbers = Array.from(key.array.subarray(4 * row, 4 * row + 4));
      const name = numbers.join("/");
      let voxel = this.voxels.get(name);
      if (!voxel) {
        voxel = { name, key: numbers, box: new Box3(), sphere: new Sphere(), points: 0, resident: false, state: "evicted", object: null, detail: -1 };
        this.voxels.set(name, voxel);
      }
      voxel.box.min.fromArray(low.array, 3 * row);
      voxel.box.max.fromArray(high.array, 3 * row);
      voxel.box.getBoundingSphere(voxel.sphere);
      voxel.points = points.array[row];
      voxel.resident = resident.array[row] !== 0;
      if (voxel.resident !== ["loaded", "prefetched"].includes(voxel.state)) voxel.state = voxel.resident ? "loaded" : "evicted";
    }
    this.version += 1;
  }

  /** Take changes of what is in the server's memory. */
  change({ lost, arrays, resident, bytes }) {
    const { key, state } = arrays;
    for (let row = 0; row < key.rows; row += 1) {
      const voxel = this.voxels.get(key.array.subarray(4 * row, 4 * row + 4).join("/"));
      if (!voxel) continue;
      voxel.state = STATES[state.array[row]] ?? "evicted";
      voxel.resident = voxel.state === "loaded" || voxel.state === "prefetched";
      if (voxel.state === "wasted") this.wasted += 1;
    }
    Object.assign(this, { resident, residentBytes: bytes });
    if (key.rows) this.version += 1;
    // What was missed is in the next list.
    if (lost) this.listed.time = -Infinity;
  }

  /** Take a tile, unless a better one of its voxel has arrived. */
  take({ key, detail, matrix, step, total, radius, arrays }) {
    const voxel = this.voxels.get(key.join("/"));
    if (!voxel || (voxel.object && voxel.detail <= detail)) return;
    this.drop(voxel);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(arrays.points.array, 3, false));
    for (const [name, { array, columns }] of Object.entries(arrays)) {
      if (name === "points") continue;
      geometry.setAttribute(name, new BufferAttribute(array, columns, name === "rgb"));
      this.columns.add(name);
      if (name === "intensity") widen(array);
    }
    // three would compute it from all points.
    const inverse = 1 / step;
    const placed = new Matrix4().set(...matrix.flat());
    placed.multiply(new Matrix4().makeScale(step, step, step));
    geometry.boundingSphere = voxel.sphere.clone().applyMatrix4(placed.clone().invert());
    geometry.boundingSphere.radius = voxel.sphere.radius * inverse;
    const object = new Points(geometry, pointsMaterial(2 * radius));
    object.matrixAutoUpdate = false;
    object.matrix.copy(placed);
    object.matrixWorldNeedsUpdate = true;
    Object.assign(voxel, { object, detail, loaded: arrays.points.rows, total, radius });
    this.group.add(object);
    this.group.changed();
    this.radius = Math.max(radius, 1e-4);
    this.changes += 1;
    this.show(voxel, Math.max(detail, voxel.wanted ?? detail));
    this.drawn(voxel);
  }

  /** Note that a tile cannot be had. */
  miss({ key, again }) {
    if (!again) this.failed.set(key.join("/"), true);
    this.sentWanted = "";
  }

  drop(voxel) {
    if (!voxel.object) return;
    this.group.remove(voxel.object);
    this.group.changed();
    voxel.object.geometry.dispose();
    voxel.object.material.dispose();
    Object.assign(voxel, { object: null, detail: -1, loaded: 0, drawn: 0 });
  }

  /** Draw a voxel in a detail, or in the finest one that has arrived. */
  show(voxel, detail) {
    const shownDetail = Math.max(detail, voxel.detail);
    const count = Math.min(voxel.loaded, Math.ceil(voxel.loaded / 4 ** (shownDetail - voxel.detail)));
    voxel.object.geometry.setDrawRange(0, count);
    voxel.object.material.uniforms.uSize.value = 2.6 * voxel.radius * 2 ** shownDetail * this.pointSize;
    voxel.drawn = count;
    voxel.shownDetail = shownDetail;
  }

  /** Choose details for a camera, and ask for what is missing.
   *
   * budget: of points that may be drawn when nothing moves.  drawn: that may be drawn now.  now: [ms].
   */
  choose(camera, focus, budget, drawn, now) {
    const { waiting, time } = this.listed;
    const { size } = this.voxels, way = size > LONG_LIST ? LONG_LIST_WAY : LIST_WAY;
    if ((!waiting || now - time > LIST_LOST_MS) && (now - time > Math.max(LIST_MS, LIST_VOXEL_MS * size)
      || !this.listed.place || this.listed.place.distanceTo(focus) > way)) {
      this.send({ type: "around", place: focus.toArray() });
      this.listed = { place: focus.clone(), time: now, waiting: true };
    }
    if (!this.voxels.size) return;
    const frustum = new Frustum().setFromProjectionMatrix(
      new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse));
    const spacing = 2 * this.radius * shared.uScale.value;
    const ordered = [...this.voxels.values()];
    for (const voxel of ordered) {
      voxel.away = Math.max(0.5, Math.sqrt(distanceTo(voxel.box, camera.position)));
      voxel.factor = frustum.intersectsSphere(voxel.sphere) ? 1 : BEHIND;
    }
    const fit = (voxels, most) => {
      let pixels = FINE;
      const cost = (sum, each) => sum + each.points / 4 ** detailOf(each, pixels, spacing);
      while (pixels < 4096 && voxels.reduce(cost, 0) > most) pixels *= 1.25;
      return pixels;
    };
    const pixels = fit(ordered, budget);
    // What is behind the camera takes no time.
    const drawnPixels = drawn < budget ? Math.max(pixels, fit(ordered.filter((each) => each.factor === 1), drawn)) : pixels;
    this.shown = 0;
    const missing = [];
    let kept = 0;
    for (const voxel of ordered) {
      voxel.wanted = detailOf(voxel, pixels, spacing);
      // The projected error of what is drawn.
      const lacks = voxel.object ? voxel.detail - voxel.wanted : MAX_DETAIL;
      if (lacks > 0 && !this.failed.has(voxel.name)) missing.push({ voxel, urgency: (2 ** lacks * voxel.points ** 0.5) / (voxel.away * voxel.factor) });
      if (voxel.object) {
        this.show(voxel, detailOf(voxel, drawnPixels, spacing));
        if (voxel.factor === 1) this.shown += voxel.drawn;
        kept += voxel.loaded;
      }
    }
    if (kept > KEPT * budget) this.forget(ordered, kept - KEPT * budget);
    missing.sort((one, other) => other.urgency - one.urgency);
    const wanted = missing.slice(0, MOST_WANTED).map(({ voxel }) => [...voxel.key, voxel.wanted]);
    const text = JSON.stringify(wanted);
    this.missing = missing.length;
    if (text !== this.sentWanted) {
      this.sentWanted = text;
      this.send({ type: "want", tiles: wanted });
    }
  }

  /** Keep of tiles that are finer than wanted only what is drawn, farthest first. */
  forget(ordered, excess) {
    const spare = ordered.filter((each) => each.object && each.detail < each.shownDetail);
    spare.sort((one, other) => other.away - one.away);
    for (const voxel of spare) {
      if (excess <= 0) break;
      excess -= voxel.loaded - voxel.drawn;
      this.shrink(voxel);
    }
  }

  /** Replace the arrays of a tile by their beginning, which is the coarser detail. */
  shrink(voxel) {
    const { geometry } = voxel.object;
    const smaller = new BufferGeometry();
    for (const [name, { array, itemSize, normalized }] of Object.entries(geometry.attributes)) {
      smaller.setAttribute(name, new BufferAttribute(array.slice(0, voxel.drawn * itemSize), itemSize, normalized));
    }
    smaller.boundingSphere = geometry.boundingSphere;
    voxel.object.geometry = smaller;
    this.group.changed();
    geometry.dispose();
    // What is drawn now may be coarser than what is wanted.
    voxel.loaded = voxel.drawn;
    voxel.detail = voxel.shownDetail;
  }
}

function detailOf(voxel, pixels, spacing) {
  const detail = Math.floor(Math.log2((pixels * voxel.factor * voxel.away) / spacing));
  return Math.min(MAX_DETAIL, Math.max(0, detail));
}

const nearest = new Vector3();
function distanceTo(box, place) {
  return box.clampPoint(place, nearest).distanceToSquared(place);
}

// Widen the range of intensities to most of a tile's.
const range = { low: Infinity, high: -Infinity };
function widen(values) {
  const sample = Float32Array.from({ length: Math.min(256, values.length) },
    (_, k) => values[Math.floor((k * values.length) / Math.min(256, values.length))]).sort();
  if (!sample.length) return;
  range.low = Math.min(range.low, sample[Math.floor(0.02 * sample.length)]);
  range.high = Math.max(range.high, sample[Math.floor(0.98 * (sample.length - 1))]);
  shared.uIntensity.value.set(range.low, range.high);
}
