// A picture in memory: a colour and a depth for each pixel, and its canvas.
//
// Depths are 1 / w, with w the distance along the view [m]: linear in the picture, larger when nearer,
// 0 where nothing is. Colours are bytes red, green, blue, alpha, as one integer.

import { Kernel } from "./kernel.js";
import { splat } from "./splats.js";

// Strength of the shading by depth, and the sum of steps from which on its table is black.
const STRENGTH = 7, DARKEST = 1, SHADES = 1024;

export class Picture {
  /** canvas: shows the picture.  ground: colour where nothing is. */
  constructor(canvas, ground) {
    this.canvas = canvas;
    this.ground = ground;
    this.context = canvas.getContext("2d", { alpha: false });
    this.shadeTable = Uint16Array.from({ length: SHADES + 1 },
      (_, k) => Math.round(256 * Math.exp((-STRENGTH * DARKEST * k) / SHADES)));
    this.kernel = null;
    this.resize(1, 1);
    // Until it is there, pictures are drawn without it.
    Kernel.made().then((kernel) => {
      if (!kernel) return;
      this.kernel = kernel;
      this.allot();
    });
  }

  resize(width, height) {
    if (this.width === width && this.height === height) return;
    Object.assign(this, { width, height });
    this.canvas.width = width;
    this.canvas.height = height;
    this.allot();
  }

  /** Make the arrays of the picture. */
  allot() {
    const { width, height } = this;
    const arrays = this.kernel?.resize(width, height);
    this.image = arrays ? new ImageData(arrays.colours, width, height) : new ImageData(width, height);
    const { buffer, byteOffset } = this.image.data;
    this.colour = new Uint32Array(buffer, byteOffset, width * height);
    this.depth = arrays ? arrays.depth : new Float32Array(width * height);
    this.splat = arrays ? (...all) => this.kernel.splat(...all) : (...all) => splat(this, ...all);
    this.loop = arrays ? "wasm" : "js";
    this.logarithms = null;
  }

  clear() {
    this.colour.fill(this.ground);
    this.depth.fill(0);
  }

  show() {
    this.context.putImageData(this.image, 0, 0);
  }

  /** Darken pixels that lie behind their neighbours: as the shader in view.js. */
  shade() {
    const { width, height, colour, shadeTable } = this;
    this.logarithms ??= new Float32Array(width * height);
    const away = this.logarithms;
    logarithms(new Int32Array(this.depth.buffer, this.depth.byteOffset, this.depth.length), away);
    const scale = SHADES / DARKEST;
    for (let row = 0; row < height; row += 1) {
      const above = row > 0 ? -width : 0, below = row < height - 1 ? width : 0;
      for (let column = 0; column < width; column += 1) {
        const at = row * width + column;
        const here = away[at];
        if (here > 100) continue;
        const right = here - away[column < width - 1 ? at + 1 : at], left = here - away[column > 0 ? at - 1 : at];
        const up = here - away[at + above], down = here - away[at + below];
        let sum = 0;
        if (right > 0) sum += right;
        if (left > 0) sum += left;
        if (up > 0) sum += up;
        if (down > 0) sum += down;
        if (sum < 1e-3) continue;
        colour[at] = mixed(colour[at], 0xff000000, sum >= DARKEST ? 256 - shadeTable[SHADES] : 256 - shadeTable[(sum * scale) | 0]);
      }
    }
  }
}

/** Write binary logarithms of distances w; 127 where there is none. bits: of depths 1 / w.
 *
 * The logarithm of the mantissa is a parabola through its ends, with an error below 0.01.
 */
function logarithms(bits, away) {
  for (let k = 0; k < bits.length; k += 1) {
    const each = bits[k];
    const part = 1 + (each & 0x7fffff) * 2 ** -23;
    away[k] = 128 - (each >> 23) - (2 - part / 3) * part + 2 / 3;
  }
}

/** Return a colour mixed with another one. share: of the other one, 0 to 256. */
export function mixed(colour, other, share) {
  const rest = 256 - share;
  const outer = (Math.imul(colour & 0xff00ff, rest) + Math.imul(other & 0xff00ff, share)) >>> 8;
  const inner = (Math.imul((colour >>> 8) & 0xff, rest) + Math.imul((other >>> 8) & 0xff, share)) >>> 8;
  return (0xff000000 | (outer & 0xff00ff) | (inner << 8)) >>> 0;
}

/** Return red, green and blue, 0 to 1, as a colour. */
export function packed(red, green, blue) {
  const byte = (value) => Math.max(0, Math.min(255, Math.round(255 * value)));
  return (0xff000000 | (byte(blue) << 16) | (byte(green) << 8) | byte(red)) >>> 0;
}
