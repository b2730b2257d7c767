// Figures, triangles and lines into a picture: what else three.js draws while a user walks.

import { Matrix4, Vector3 } from "../vendor/three.module.min.js";
import { mixed, packed } from "./picture.js";

// A little sphere's light by place on its disc: 0 outside, else 1 to 255 for up to `BRIGHTEST`.
const SIDE = 32, BRIGHTEST = 1.04;
const LIGHT = lights();
const NEAR = 0.05;

function lights() {
  const found = new Uint8Array(SIDE * SIDE);
  const sun = new Vector3(-0.35, 0.75, 0.6).normalize();
  for (let row = 0; row < SIDE; row += 1) {
    for (let column = 0; column < SIDE; column += 1) {
      const x = (2 * (column + 0.5)) / SIDE - 1, y = (2 * (row + 0.5)) / SIDE - 1;
      const square = x * x + y * y;
      if (square > 1) continue;
      const facing = Math.max(0, x * sun.x - y * sun.y + Math.sqrt(1 - square) * sun.z);
      found[row * SIDE + column] = Math.max(1, Math.round((255 * (0.42 + 0.62 * facing)) / BRIGHTEST));
    }
  }
  return found;
}

const combined = new Matrix4();

/** Return rows for x, y (times w, pixels) and w of a place in an object's frame. view: from the world to the picture. */
export function screenRows(picture, view, matrixWorld) {
  const { elements: m } = combined.multiplyMatrices(view, matrixWorld);
  const { width, height } = picture;
  const rows = new Float64Array(12);
  for (let k = 0; k < 4; k += 1) {
    rows[k] = 0.5 * width * (m[4 * k] + m[4 * k + 3]);
    rows[4 + k] = 0.5 * height * (m[4 * k + 3] - m[4 * k + 1]);
    rows[8 + k] = m[4 * k + 3];
  }
  return rows;
}

/** Draw a figure: see avatar.js. size: diameter of its spheres at w = 1 [pixels].  colour: (3,). */
export function figure(picture, places, rows, size, tint) {
  const { depth, colour, width, height } = picture;
  const [a, b, c, d, e, f, g, h, p, q, r, s] = rows;
  const shades = shadesOf(tint);
  for (let at = 0; at < places.length; at += 3) {
    const x = places[at], y = places[at + 1], z = places[at + 2];
    const w = p * x + q * y + r * z + s;
    if (w < NEAR) continue;
    const inverse = 1 / w;
    const u = (a * x + b * y + c * z + d) * inverse, v = (e * x + f * y + g * z + h) * inverse;
    if (!(u >= 0 && u < width && v >= 0 && v < height)) continue;
    const diameter = Math.min(Math.max(2, size * inverse), 256), half = 0.5 * diameter;
    const lift = 0.82 + 0.09 * Math.max(0, Math.min(2, z)), scale = SIDE / diameter;
    const left = Math.max(0, (u - half + 0.5) | 0), right = Math.min(width, (u + half + 0.5) | 0);
    const bottom = Math.min(height, (v + half + 0.5) | 0);
    for (let line = Math.max(0, (v - half + 0.5) | 0); line < bottom; line += 1) {
      const lit = (((line + 0.5 - v + half) * scale) | 0) * SIDE;
      for (let column = left, pixel = line * width + left; column < right; column += 1, pixel += 1) {
        if (inverse <= depth[pixel]) continue;
        const light = LIGHT[lit + (((column + 0.5 - u + half) * scale) | 0)];
        if (light === 0) continue;
        depth[pixel] = inverse;
        colour[pixel] = shades[(light * lift) | 0];
      }
    }
  }
}

const kept = new Map();
function shadesOf(tint) {
  const name = tint.join();
  if (!kept.has(name)) {
    kept.set(name, Uint32Array.from({ length: 256 }, (_, k) => packed(...tint.map((part) => (part * k * BRIGHTEST) / 255))));
  }
  return kept.get(name);
}

/** Return places as x, y [pixels] and 1 / w, (n, 3) as one array; 1 / w is 0 where a place is not before the camera. */
function projected(places, [a, b, c, d, e, f, g, h, p, q, r, s]) {
  const found = new Float64Array(places.length);
  for (let at = 0; at < places.length; at += 3) {
    const x = places[at], y = places[at + 1], z = places[at + 2];
    const w = p * x + q * y + r * z + s;
    if (w < NEAR) continue;
    found[at] = (a * x + b * y + c * z + d) / w;
    found[at + 1] = (e * x + f * y + g * z + h) / w;
    found[at + 2] = 1 / w;
  }
  return found;
}

/** Draw triangles in one colour. paint: colour, share 0 to 256, test and write of depths, sides. */
export function triangles(picture, places, index, rows, paint) {
  const seen = projected(places, rows);
  const count = index ? index.length : places.length / 3;
  for (let k = 0; k < count; k += 3) {
    const [one, two, three] = [k, k + 1, k + 2].map((each) => 3 * (index ? index[each] : each));
    triangle(picture, seen, one, two, three, paint);
  }
}

function triangle({ depth, colour, width, height }, seen, one, two, three, { tint, share, test, write, front }) {
  const [x0, y0, z0, x1, y1, z1, x2, y2, z2] = [
    seen[one], seen[one + 1], seen[one + 2], seen[two], seen[two + 1], seen[two + 2], seen[three], seen[three + 1], seen[three + 2],
  ];
  // Rows go down: the front's corners go round to the left.
  const area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0);
  if (z0 === 0 || z1 === 0 || z2 === 0 || area === 0 || (front && area > 0)) return;
  const slopeX = ((z1 - z0) * (y2 - y0) - (z2 - z0) * (y1 - y0)) / area;
  const slopeY = ((z2 - z0) * (x1 - x0) - (z1 - z0) * (x2 - x0)) / area;
  const last = Math.min(height, Math.ceil(Math.max(y0, y1, y2) - 0.5));
  for (let line = Math.max(0, Math.ceil(Math.min(y0, y1, y2) - 0.5)); line < last; line += 1) {
    const middle = line + 0.5;
    let from = Infinity, to = -Infinity;
    const cross = (ax, ay, bx, by) => {
      if ((ay <= middle) === (by <= middle)) return;
      const x = ax + ((middle - ay) * (bx - ax)) / (by - ay);
      if (x < from) from = x;
      if (x > to) to = x;
    };
    cross(x0, y0, x1, y1);
    cross(x1, y1, x2, y2);
    cross(x2, y2, x0, y0);
    const right = Math.min(width, Math.ceil(to - 0.5));
    for (let column = Math.max(0, Math.ceil(from - 0.5)); column < right; column += 1) {
      const inverse = z0 + (column + 0.5 - x0) * slopeX + (middle - y0) * slopeY;
      const pixel = line * width + column;
      if (test && inverse < depth[pixel]) continue;
      if (write) depth[pixel] = inverse;
      colour[pixel] = mixed(colour[pixel], tint, share);
    }
  }
}

/** Draw lines of a pixel. step: places from one line to the next, 2 for pairs, 1 for a chain.  tints: colours of places, or null. */
export function lines(picture, places, count, step, rows, paint, tints) {
  const [a, b, c, d, e, f, g, h, p, q, r, s] = rows;
  const end = (k) => {
    const x = places[3 * k], y = places[3 * k + 1], z = places[3 * k + 2];
    return [a * x + b * y + c * z + d, e * x + f * y + g * z + h, p * x + q * y + r * z + s];
  };
  for (let k = 0; k + 1 < count; k += step) {
    const tint = tints ? packed(tints[3 * k], tints[3 * k + 1], tints[3 * k + 2]) : paint.tint;
    line(picture, end(k), end(k + 1), tint, paint);
  }
}

function line({ depth, colour, width, height }, from, to, tint, { share, test, write }) {
  if (from[2] < NEAR && to[2] < NEAR) return;
  const cut = (near, far) => near.map((value, k) => value + ((far[k] - value) * (NEAR - near[2])) / (far[2] - near[2]));
  const [begin, end] = [from[2] < NEAR ? cut(from, to) : from, to[2] < NEAR ? cut(to, from) : to];
  const [x0, y0, z0] = [begin[0] / begin[2], begin[1] / begin[2], 1 / begin[2]];
  const [dx, dy, dz] = [end[0] / end[2] - x0, end[1] / end[2] - y0, 1 / end[2] - z0];
  // The part inside of the picture.
  let low = 0, high = 1;
  for (const [at, way, most] of [[x0, dx, width], [y0, dy, height]]) {
    if (way === 0) {
      if (at < 0 || at >= most) return;
    } else {
      low = Math.max(low, Math.min(-at / way, (most - at) / way));
      high = Math.min(high, Math.max(-at / way, (most - at) / way));
    }
  }
  if (low >= high) return;
  const steps = Math.ceil((high - low) * Math.max(Math.abs(dx), Math.abs(dy)));
  for (let k = 0; k < steps; k += 1) {
    const at = low + ((high - low) * (k + 0.5)) / steps;
    const column = (x0 + dx * at) | 0, row = (y0 + dy * at) | 0;
    if (column >= width || row >= height) continue;
    const pixel = row * width + column, inverse = z0 + dz * at;
    if (test && inverse < depth[pixel]) continue;
    if (write) depth[pixel] = inverse;
    colour[pixel] = mixed(colour[pixel], tint, share);
  }
}
