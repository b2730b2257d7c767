// Colours of scan points as the shader in points_material.js gives them, kept for each tile.

import { textures } from "../colours.js";
import { shared } from "../points_material.js";
import { packed } from "./picture.js";

const STEPS = 1024;
// Reach of the verdict's colour around the user [m].
const REACH = 1.4;

/** Return a colour of a ramp of 256, between its two nearest. at: 0 to 1. */
function ofRamp(data, at) {
  const place = Math.max(0, Math.min(255, 256 * at - 0.5)), left = Math.min(254, Math.floor(place));
  return [0, 1, 2].map((k) => {
    const [from, to] = [data[4 * left + k], data[4 * (left + 1) + k]];
    return (from + (to - from) * (place - left)) / 255;
  });
}

const table = (colour) => Uint32Array.from({ length: STEPS }, (_, k) => packed(...colour(k / (STEPS - 1))));
const ofHeight = (at) => ofRamp(textures.height.image.data, at ** 0.7);
const grey = (at) => {
  const [r, g, b] = ofHeight(at);
  return Array(3).fill((0.3 * r + 0.5 * g + 0.2 * b) * 0.55 + 0.08);
};
const palette = ({ image: { data } }) => Uint32Array.from({ length: 256 },
  (_, k) => packed(...[0, 1, 2].map((part) => data[4 * k + part] / 255)));
const tables = {};
const tableOf = (name, make) => (tables[name] ??= make());

export class PointColours {
  constructor() {
    this.kept = new WeakMap();
    this.near = new Uint32Array(0);
  }

  /** Return the colours of a tile's points.
   *
   * source: what they are kept for.  attributes: arrays by name of the columns.  places: (n, 3) as
   * one array.  matrix: 16 numbers, column by column, of the tile's frame.
   */
  of(source, attributes, places, matrix) {
    const mode = shared.uMode.value;
    const range = mode === 2 ? shared.uIntensity.value : mode === 0 || mode === 5 ? shared.uHeight.value : null;
    const found = this.kept.get(source);
    if (found && found.mode === mode && found.places === places && (!range || (found.low === range.x && found.high === range.y))) return found.colours;
    const colours = found?.colours.length === places.length / 3 ? found.colours : new Uint32Array(places.length / 3);
    paint(colours, mode, attributes, places, matrix);
    this.kept.set(source, { mode, places, low: range?.x, high: range?.y, colours });
    return colours;
  }

  /** Return colours with the verdict's around the user, for the first points of a tile, until the next call.
   *
   * m: as `matrix` of `of`.  sphere: that contains the tile, in the page's frame.
   */
  around(colours, places, count, m, sphere) {
    if (shared.uMode.value !== 5) return colours;
    const { x: userX, y: userY, z: userZ } = shared.uUser.value;
    const { x: red, y: green, z: blue, w: tall } = shared.uVerdict.value;
    const up = Math.max(0, Math.min(tall, sphere.center.z - userZ));
    const away = Math.hypot(sphere.center.x - userX, sphere.center.y - userY, sphere.center.z - userZ - up);
    if (away > sphere.radius + REACH) return colours;
    if (this.near.length < count) this.near = new Uint32Array(2 * count);
    const { near } = this;
    for (let row = 0; row < count; row += 1) {
      const px = places[3 * row], py = places[3 * row + 1], pz = places[3 * row + 2];
      const x = m[0] * px + m[4] * py + m[8] * pz + m[12], y = m[1] * px + m[5] * py + m[9] * pz + m[13];
      const z = m[2] * px + m[6] * py + m[10] * pz + m[14];
      const part = Math.max(0, Math.min(tall, z - userZ));
      const t = Math.max(0, Math.min(1, (Math.sqrt((x - userX) ** 2 + (y - userY) ** 2 + (z - userZ - part) ** 2) - 0.35) / (REACH - 0.35)));
      const share = t * t * (3 - 2 * t);
      const level = ((colours[row] & 0xff) / 255) * share, rest = 1 - share;
      near[row] = packed(red * rest + level, green * rest + level, blue * rest + level);
    }
    return near;
  }
}

function paint(colours, mode, { rgb, intensity, classification, scan }, places, m) {
  const count = colours.length;
  if (mode === 1) {
    for (let row = 0; row < count; row += 1) {
      colours[row] = rgb ? 0xff000000 | (rgb[3 * row + 2] << 16) | (rgb[3 * row + 1] << 8) | rgb[3 * row] : 0xff000000;
    }
  } else if (mode === 2) {
    const { x: low, y: high } = shared.uIntensity.value;
    const ramp = tableOf("intensity", () => table((at) => ofRamp(textures.intensity.image.data, at)));
    const scale = (STEPS - 1) / Math.max(high - low, 1e-6);
    for (let row = 0; row < count; row += 1) {
      colours[row] = ramp[Math.max(0, Math.min(STEPS - 1, ((intensity?.[row] ?? 0) - low) * scale + 0.5)) | 0];
    }
  } else if (mode === 3 || mode === 4) {
    const name = mode === 3 ? "classification" : "scan", column = mode === 3 ? classification : scan;
    const all = tableOf(name, () => palette(textures[name]));
    for (let row = 0; row < count; row += 1) colours[row] = all[(column?.[row] ?? 0) & 255];
  } else {
    const { x: low, y: high } = shared.uHeight.value;
    const ramp = mode === 5 ? tableOf("grey", () => table(grey)) : tableOf("height", () => table(ofHeight));
    const scale = (STEPS - 1) / Math.max(high - low, 1e-3);
    const a = m[2] * scale, b = m[6] * scale, c = m[10] * scale, d = (m[14] - low) * scale + 0.5;
    for (let row = 0, at = 0; row < count; row += 1, at += 3) {
      const place = a * places[at] + b * places[at + 1] + c * places[at + 2] + d;
      colours[row] = ramp[place < 0 ? 0 : place > STEPS - 1 ? STEPS - 1 : place | 0];
    }
  }
}
