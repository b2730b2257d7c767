// The scan into a picture: tiles and overview, nearest first.

import { Frustum, Matrix4, Sphere, Vector3 } from "../vendor/three.module.min.js";
import { shared } from "../points_material.js";
import { PointColours } from "./colours.js";
import { boxesOf, seenRuns } from "./runs.js";
import { screenRows } from "./shapes.js";
import { fogTables } from "./splats.js";

export class Scan {
  constructor() {
    this.colours = new PointColours();
    this.packed = new WeakMap();
    this.boxes = new WeakMap();
    this.fog = fogTables(shared.uGround.value.toArray());
  }

  /** Draw scan points. tiles: `TileGroup`, or null.  scan: other objects of three.js with the material
   * of points_material.js: the overview.  view: from the world to the picture, as a matrix.
   *
   * Returns how many points they have, how many of them were given to the inner loop, and how many were
   * inside of the picture.
   */
  draw(picture, { tiles, scan }, camera, view) {
    const ordered = [];
    const add = (tile, object, away) => {
      tile.count = Math.min(object.geometry.drawRange.count, tile.places.length / 3);
      tile.size = object.material.uniforms.uSize.value * shared.uScale.value;
      tile.away = away;
      if (tile.count > 0) ordered.push(tile);
    };
    // The overview is behind the tiles, mostly.
    for (const object of scan) if (object.geometry.drawRange.count > 0) add(this.pack(object.geometry), object, Infinity);
    if (tiles) {
      const spheres = tiles.list(), planes = planesOf(view), { x, y, z } = camera.position;
      tiles.children.forEach((object, k) => {
        const at = 4 * k;
        if (!meets(planes, spheres, at)) return;
        add(tileOf(object), object, Math.hypot(spheres[at] - x, spheres[at + 1] - y, spheres[at + 2] - z) - spheres[at + 3]);
      });
    }
    ordered.sort((one, other) => one.away - other.away);
    const found = { chosen: 0, given: 0, inside: 0 };
    for (const tile of ordered) this.tile(picture, tile, camera, view, found);
    return found;
  }

  tile(picture, tile, camera, view, found) {
    const { matrix, inverse, sphere, attributes, source, places, count } = tile;
    const { elements } = matrix;
    const screen = screenRows(picture, view, matrix);
    const runs = count <= FEW ? [0, count] : seenRuns(this.boxesOf(places), count, screen, picture.width, picture.height, camera.near);
    found.chosen += count;
    if (!runs.length) return;
    const last = runs.at(-1);
    eye.copy(camera.position).applyMatrix4(inverse);
    const { x: least, y: most } = shared.uPixels.value;
    const step = Math.hypot(elements[0], elements[1], elements[2]), fog = step / shared.uFog.value;
    const cut = cutOf(tile.away, sphere, camera.position, elements, step);
    const colours = this.colours.around(this.colours.of(source, attributes, places, elements), places, last, elements, sphere);
    for (let k = 0; k < runs.length; k += 2) {
      const [from, to] = [runs[k], runs[k + 1]];
      found.given += to - from;
      found.inside += picture.splat(places, colours, from, to, screen, tile.size, least, most, camera.near,
        [eye.x, eye.y, eye.z, fog * fog], this.fog, cut);
    }
  }

  boxesOf(places) {
    if (!this.boxes.has(places)) this.boxes.set(places, boxesOf(places));
    return this.boxes.get(places);
  }

  /** Return the points of an index in its order, in a frame of their box in 65,535 steps. */
  pack(geometry) {
    const { index, attributes, drawRange } = geometry;
    const found = this.packed.get(geometry);
    // The index changes as a whole, and its beginning is drawn.
    if (found && found.version === index.version && found.rows >= drawRange.count) return found;
    const { array } = attributes.position;
    const rows = found && found.version === index.version ? index.count : Math.min(index.count, drawRange.count);
    const frame = found ?? boxFrame(array);
    const columns = Object.entries(attributes).filter(([name]) => name !== "position");
    const packed = Object.fromEntries(columns.map(([name, each]) => [name, new each.array.constructor(rows * each.itemSize)]));
    const places = new Uint16Array(3 * rows);
    for (let row = 0; row < rows; row += 1) {
      const from = index.array[row];
      for (let axis = 0; axis < 3; axis += 1) places[3 * row + axis] = (array[3 * from + axis] - frame.low[axis]) / frame.step + 0.5;
      for (const [name, { array: values, itemSize }] of columns) {
        for (let part = 0; part < itemSize; part += 1) packed[name][itemSize * row + part] = values[itemSize * from + part];
      }
    }
    const made = { ...frame, version: index.version, rows, places, attributes: packed, source: places };
    this.packed.set(geometry, made);
    return made;
  }
}

// Tiles with at most this many points in a picture are given to the inner loop as a whole. A town of 10^8
// points has thousands of them.
const FEW = 256;
const eye = new Vector3();

/** Return what does not change of a tile while its points and its place are the same. */
function tileOf(object) {
  const { geometry, matrixWorld, userData } = object;
  const found = userData.tile;
  if (found && found.source === geometry && found.matrix.equals(matrixWorld)) return found;
  userData.tile = {
    places: geometry.attributes.position.array, attributes: arrays(geometry), source: geometry,
    matrix: matrixWorld.clone(), inverse: matrixWorld.clone().invert(),
    sphere: geometry.boundingSphere.clone().applyMatrix4(matrixWorld), count: 0, size: 0, away: 0,
  };
  return userData.tile;
}

/** Return the planes around what a picture shows, (6, 4) as one array: unit normals inwards, and constants. */
function planesOf(view) {
  const { planes } = new Frustum().setFromProjectionMatrix(view);
  return Float64Array.from(planes.flatMap(({ normal, constant }) => [normal.x, normal.y, normal.z, constant]));
}

/** Return whether a sphere, of (n, 4) from `at` on, meets the space within planes. */
function meets(planes, spheres, at) {
  const x = spheres[at], y = spheres[at + 1], z = spheres[at + 2], radius = spheres[at + 3];
  for (let k = 0; k < 24; k += 4) {
    if (planes[k] * x + planes[k + 1] * y + planes[k + 2] * z + planes[k + 3] < -radius) return false;
  }
  return true;
}

const arrays = ({ attributes }) => Object.fromEntries(Object.entries(attributes).map(([name, { array }]) => [name, array]));

/** Return a frame of the box of places, (n, 3) as one array. */
function boxFrame(places) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let at = 0; at < places.length; at += 3) {
    for (let axis = 0; axis < 3; axis += 1) {
      low[axis] = Math.min(low[axis], places[at + axis]);
      high[axis] = Math.max(high[axis], places[at + axis]);
    }
  }
  const step = Math.max(1e-6, ...high.map((value, axis) => (value - low[axis]) / 65534));
  const sphere = new Sphere(new Vector3(...low).add(new Vector3(...high)).multiplyScalar(0.5));
  sphere.radius = sphere.center.distanceTo(new Vector3(...high));
  const matrix = new Matrix4().makeTranslation(...low).scale(new Vector3(step, step, step));
  return { low, step, matrix, inverse: matrix.clone().invert(), sphere };
}

const NOTHING_CUT = [0, 0, 0, 0, -1, 0, 0];

/** Return what is left out between the camera and the user, as the shader does: `cut` of splats.js.
 *
 * away: least distance of the tile.  sphere: that contains it, in the page's frame.  m: matrix of the tile's frame, whose axes are at right
 * angles.  step: of the frame [m].
 */
function cutOf(away, sphere, camera, m, step) {
  const { x, y, z, w: radius } = shared.uCut.value;
  if (radius <= 0 || away > Math.hypot(x - camera.x, y - camera.y, z - camera.z) + radius) return NOTHING_CUT;
  const line = new Vector3(x, y, z).sub(camera), whole = line.length();
  line.divideScalar(whole);
  const way = sphere.center.clone().sub(camera), along = way.dot(line);
  const beside = Math.sqrt(Math.max(0, way.lengthSq() - along * along));
  // Behind the camera nothing is seen.
  if (along < -sphere.radius || along > whole + sphere.radius || beside > radius + sphere.radius) return NOTHING_CUT;
  return [
    ...[0, 4, 8].map((at) => line.x * m[at] + line.y * m[at + 1] + line.z * m[at + 2]), step * step,
    whole - 0.55, radius, (0.65 * radius) / whole,
  ];
}
