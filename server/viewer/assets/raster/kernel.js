// The inner loop in WebAssembly (splats.ts), with the arrays of the picture in its memory.
//
// It takes half the time of splats.js or less (figures: DESIGN.md). splats.js draws where a browser has no
// vectors in WebAssembly, and in pictures that are too narrow for them.

import { FOG_END, FOG_STEPS } from "./splats.js";

// Points that are copied into the memory at once.
const MOST = 16384;
// Most points that are copied one by one.
const FEW = 64;
// Least width and height of a picture [pixels]: a row has a disc's largest width.
const LEAST_SIDE = 64;
// Addresses, and bytes of the lists: see splats.ts. The page's arrays are behind them.
const FOG = 1024, NUMBERS = FOG + 3 * 4 * FOG_STEPS, LISTS = NUMBERS + 128, PLACES = LISTS + 4 * 4096 + 128;
const TINTS = PLACES + 6 * MOST + 64, PICTURE = TINTS + 4 * MOST + 64;
const PAGE = 65536;

export class Kernel {
  /** Return the kernel, or null where a browser cannot compile it. */
  static async made() {
    try {
      const memory = new WebAssembly.Memory({ initial: 1 });
      const file = fetch(new URL("splats.wasm", import.meta.url));
      const { instance } = await WebAssembly.instantiateStreaming(file, { env: { memory } });
      return new Kernel(memory, instance.exports);
    } catch (error) {
      console.info(error);
      return null;
    }
  }

  constructor(memory, functions) {
    this.memory = memory;
    this.functions = functions;
    this.fog = null;
  }

  /** Return colours and depths of a picture, which are valid until the next call; null if it is too small. */
  resize(width, height) {
    if (width < LEAST_SIDE || height < LEAST_SIDE) return null;
    const pixels = width * height, colours = PICTURE + 4 * pixels;
    const lacking = Math.ceil((colours + 4 * pixels) / PAGE) - this.memory.buffer.byteLength / PAGE;
    if (lacking > 0) this.memory.grow(lacking);
    const { buffer } = this.memory;
    this.numbers = new Float32Array(buffer, NUMBERS, 27);
    this.places = new Uint16Array(buffer, PLACES, 3 * MOST);
    this.tints = new Uint32Array(buffer, TINTS, MOST);
    this.functions.begin(PICTURE, colours, width, height);
    return { depth: new Float32Array(buffer, PICTURE, pixels), colours: new Uint8ClampedArray(buffer, colours, 4 * pixels) };
  }

  /** Copy points into the memory. */
  take(places, colours, begin, end) {
    const { places: into, tints } = this;
    if (end - begin > FEW) {
      into.set(places.subarray(3 * begin, 3 * end));
      tints.set(colours.subarray(begin, end));
      return;
    }
    // Two views and their copies take longer than few points.
    for (let at = 3 * begin, to = 0; at < 3 * end; at += 1, to += 1) into[to] = places[at];
    for (let row = begin, to = 0; row < end; row += 1, to += 1) tints[to] = colours[row];
  }

  /** Draw points, as `splat` of splats.js does. */
  splat(places, colours, from, to, screen, size, least, most, near, [eyeX, eyeY, eyeZ, foggy], fog, cut) {
    if (this.fog !== fog) {
      this.fog = fog;
      [fog.shares, fog.redBlue, fog.green].forEach((table, k) => new Int32Array(this.memory.buffer, FOG + 4 * FOG_STEPS * k, FOG_STEPS).set(table));
    }
    const { numbers } = this;
    for (let k = 0; k < 12; k += 1) numbers[k] = screen[k];
    numbers[12] = size;
    numbers[13] = least;
    numbers[14] = most;
    numbers[15] = near;
    numbers[16] = eyeX;
    numbers[17] = eyeY;
    numbers[18] = eyeZ;
    numbers[19] = (foggy * FOG_STEPS) / FOG_END;
    for (let k = 0; k < 7; k += 1) numbers[20 + k] = cut[k];
    let inside = 0;
    for (let begin = from; begin < to; begin += MOST) {
      const end = Math.min(to, begin + MOST);
      this.take(places, colours, begin, end);
      inside += this.functions.splat(PLACES, TINTS, end - begin, NUMBERS, FOG, LISTS);
    }
    return inside;
  }
}
