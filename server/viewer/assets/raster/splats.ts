// The inner loop in WebAssembly: points of a tile into a picture, four pixels at once.
//
// It draws what splats.js draws; see there for the rules. Written in AssemblyScript; scripts/make_raster
// compiles it to splats.wasm. The page gives the addresses of all arrays: see splats_wasm.js.
//
// Points are taken in pieces. Each piece is projected and sorted by size into lists first, and then the
// lists are drawn: a loop over points of one size has branches that a processor predicts.

/** Points of a piece, whose lists stay in the processor's first cache; bytes of an entry of a list: u, v,
 * 1 / w, diameter, colour; bytes of a list.
 */
const PIECE: i32 = 128, ENTRY: usize = 32, LIST: usize = <usize>PIECE * ENTRY;
/** Diameters up to which a point is four pixels, a square of at most 4, and a disc of at most 8 [pixels]. */
const FOUR: f32 = 2.6, SQUARE: f32 = 4.5, SMALL: f32 = 8;
/** Half of a square's side, as a share of the diameter. */
const HALF_SIDE: f32 = 0.443113463, HALF: f32 = 0.5, ARM: f32 = 0.9;
const FOG_STEPS: i32 = 1024;
const ORDER = i32x4(0, 1, 2, 3), MIDDLES = f32x4(0.5, 1.5, 2.5, 3.5);

// Of the picture.
let width: i32 = 0, height: i32 = 0;
let depths: usize = 0, colours: usize = 0, delta: usize = 0, stride: usize = 0;

/** Choose the picture. depth, colour: arrays of (high, wide) f4 and u4; 32 bytes behind each are free. */
export function begin(depth: usize, colour: usize, wide: i32, high: i32): void {
  depths = depth;
  colours = colour;
  width = wide;
  height = high;
  delta = colour - depth;
  stride = <usize>wide << 2;
}

/** Draw points; return how many were inside of the picture.
 *
 * places, tints: (n, 3) u2 and (n) u4; 32 bytes behind each are free.  numbers: 27 f4, which are the 12 of
 * `screen`, size, least, most, near, the 4 of `eye` and the 7 of `cut` of `splat` in splats.js; the fourth of
 * `eye` is in steps of the fog's tables.  fog: its three tables, one after the other.  lists: 4 lists of `LIST` bytes.
 */
export function splat(places: usize, tints: usize, count: i32, numbers: usize, fog: usize, lists: usize): i32 {
  let inside = 0;
  for (let from = 0; from < count; from += PIECE) {
    const many = min(PIECE, count - from);
    inside += project(places + 6 * <usize>from, tints + 4 * <usize>from, many, numbers, fog, lists);
  }
  return inside;
}

// @ts-ignore: decorator
@inline
function row(numbers: usize, k: usize, x: v128, y: v128, z: v128): v128 {
  const at = numbers + 16 * k;
  return f32x4.add(
    f32x4.add(f32x4.mul(v128.load32_splat(at), x), f32x4.mul(v128.load32_splat(at, 4), y)),
    f32x4.add(f32x4.mul(v128.load32_splat(at, 8), z), v128.load32_splat(at, 12)));
}

// @ts-ignore: decorator
@inline
function square(x: v128): v128 {
  return f32x4.mul(x, x);
}

function project(places: usize, tints: usize, count: i32, numbers: usize, fog: usize, lists: usize): i32 {
  let ends0 = lists, ends1 = lists + LIST, ends2 = lists + 2 * LIST, ends3 = lists + 3 * LIST;
  const size = v128.load32_splat(numbers, 48), least = v128.load32_splat(numbers, 52);
  const most = v128.load32_splat(numbers, 56), near = v128.load32_splat(numbers, 60);
  const eyeX = v128.load32_splat(numbers, 64), eyeY = v128.load32_splat(numbers, 68);
  const eyeZ = v128.load32_splat(numbers, 72), foggy = v128.load32_splat(numbers, 76);
  const wide = f32x4.splat(<f32>width), high = f32x4.splat(<f32>height), zero = f32x4.splat(0);
  const cutX = v128.load32_splat(numbers, 80), cutY = v128.load32_splat(numbers, 84), cutZ = v128.load32_splat(numbers, 88);
  const scale = v128.load32_splat(numbers, 92), limit = v128.load32_splat(numbers, 96);
  const radius = v128.load32_splat(numbers, 100), narrowing = v128.load32_splat(numbers, 104);
  let inside = 0;
  for (let k = 0; k < count; k += 4, places += 24, tints += 16) {
    // Four places: x, y and z of each, from two overlapping loads.
    const low = v128.load(places), high8 = v128.load(places, 8);
    const x = f32x4.convert_i32x4_u(i32x4.extend_low_i16x8_u(v128.shuffle<u16>(low, high8, 0, 3, 6, 13, 0, 0, 0, 0)));
    const y = f32x4.convert_i32x4_u(i32x4.extend_low_i16x8_u(v128.shuffle<u16>(low, high8, 1, 4, 7, 14, 0, 0, 0, 0)));
    const z = f32x4.convert_i32x4_u(i32x4.extend_low_i16x8_u(v128.shuffle<u16>(low, high8, 2, 5, 12, 15, 0, 0, 0, 0)));
    const w = row(numbers, 2, x, y, z);
    const inverse = f32x4.div(f32x4.splat(1), w);
    const u = f32x4.mul(row(numbers, 0, x, y, z), inverse), v = f32x4.mul(row(numbers, 1, x, y, z), inverse);
    const dx = f32x4.sub(x, eyeX), dy = f32x4.sub(y, eyeY), dz = f32x4.sub(z, eyeZ);
    const away = f32x4.add(f32x4.add(square(dx), square(dy)), square(dz));
    // What is between the camera and the user is left out.
    const along = f32x4.add(f32x4.add(f32x4.mul(cutX, dx), f32x4.mul(cutY, dy)), f32x4.mul(cutZ, dz));
    const beside = f32x4.sub(f32x4.mul(scale, away), square(along));
    const cut = v128.and(f32x4.lt(along, limit), f32x4.lt(beside, square(f32x4.sub(radius, f32x4.mul(narrowing, along)))));
    const seen = v128.andnot(v128.and(
      v128.and(f32x4.ge(w, near), i32x4.lt_s(ORDER, i32x4.splat(count - k))),
      v128.and(v128.and(f32x4.ge(u, zero), f32x4.lt(u, wide)), v128.and(f32x4.ge(v, zero), f32x4.lt(v, high)))), cut);
    let lanes = i32x4.bitmask(seen);
    if (lanes === 0) continue;
    inside += popcnt(lanes);
    const diameter = f32x4.min(f32x4.max(f32x4.mul(size, inverse), least), most);
    const fogged = i32x4.shl(i32x4.min_s(i32x4.trunc_sat_f32x4_s(f32x4.mul(foggy, away)), i32x4.splat(FOG_STEPS - 1)), 2);
    // The numbers of each point in a row.
    const uv = v128.shuffle<f32>(u, v, 0, 4, 1, 5), uv2 = v128.shuffle<f32>(u, v, 2, 6, 3, 7);
    const id = v128.shuffle<f32>(inverse, diameter, 0, 4, 1, 5), id2 = v128.shuffle<f32>(inverse, diameter, 2, 6, 3, 7);
    v128.store(lists + 4 * LIST, v128.shuffle<u64>(uv, id, 0, 2));
    v128.store(lists + 4 * LIST, v128.shuffle<u64>(uv, id, 1, 3), 16);
    v128.store(lists + 4 * LIST, v128.shuffle<u64>(uv2, id2, 0, 2), 32);
    v128.store(lists + 4 * LIST, v128.shuffle<u64>(uv2, id2, 1, 3), 48);
    v128.store(lists + 4 * LIST, fogged, 64);
    while (lanes !== 0) {
      const lane = <usize>ctz(lanes);
      lanes &= lanes - 1;
      const entry = v128.load(lists + 4 * LIST + 16 * lane);
      const step = fog + <usize>load<u32>(lists + 4 * LIST + 4 * lane, 64);
      const rest = 256 - load<u32>(step), own = load<u32>(tints + 4 * lane);
      const outer = ((own & 0xff00ff) * rest + load<u32>(step, 4 * FOG_STEPS)) >> 8;
      const inner = (((own >> 8) & 0xff) * rest + load<u32>(step, 8 * FOG_STEPS)) >> 8;
      const shown = 0xff000000 | (outer & 0xff00ff) | (inner << 8);
      const d = f32x4.extract_lane(entry, 3);
      const place = d <= FOUR ? ends0 : d <= SQUARE ? ends1 : d <= SMALL ? ends2 : ends3;
      v128.store(place, entry);
      store<u32>(place, shown, 16);
      ends0 += d <= FOUR ? ENTRY : 0;
      ends1 += (d > FOUR) & (d <= SQUARE) ? ENTRY : 0;
      ends2 += (d > SQUARE) & (d <= SMALL) ? ENTRY : 0;
      ends3 += d > SMALL ? ENTRY : 0;
    }
  }
  fours(lists, ends0);
  squares(lists + LIST, ends1);
  small(lists + 2 * LIST, ends2);
  large(lists + 3 * LIST, ends3);
  return inside;
}

function fours(from: usize, to: usize): void {
  const lastColumn = width - 1, lastRow = height - 1;
  for (let entry = from; entry < to; entry += ENTRY) {
    const left = <i32>(load<f32>(entry) - HALF), top = <i32>(load<f32>(entry, 4) - HALF);
    if (left >= lastColumn || top >= lastRow) continue;
    const inverse = v128.load32_splat(entry, 8), shown = v128.load32_splat(entry, 16);
    const upper = depths + (<usize>(top * width + left) << 2), lower = upper + stride;
    const was = v128.load64_lane(lower, v128.load64_zero(upper), 1);
    const before = v128.load64_lane(lower + delta, v128.load64_zero(upper + delta), 1);
    const nearer = f32x4.gt(inverse, was);
    const depth = v128.bitselect(inverse, was, nearer), colour = v128.bitselect(shown, before, nearer);
    v128.store64_lane(upper, depth, 0);
    v128.store64_lane(lower, depth, 1);
    v128.store64_lane(upper + delta, colour, 0);
    v128.store64_lane(lower + delta, colour, 1);
  }
}

/** Write four pixels where `nearer` and `within`. */
// @ts-ignore: decorator
@inline
function write(at: usize, inverse: v128, shown: v128, within: v128): void {
  const was = v128.load(at), before = v128.load(at + delta);
  const nearer = v128.and(f32x4.gt(inverse, was), within);
  v128.store(at, v128.bitselect(inverse, was, nearer));
  v128.store(at + delta, v128.bitselect(shown, before, nearer));
}

function squares(from: usize, to: usize): void {
  for (let entry = from; entry < to; entry += ENTRY) {
    const u = load<f32>(entry), v = load<f32>(entry, 4), half = HALF_SIDE * load<f32>(entry, 12);
    const inverse = v128.load32_splat(entry, 8), shown = v128.load32_splat(entry, 16);
    const left = max(0, <i32>(u - half + HALF)), right = <i32>(u + half + HALF);
    const top = max(0, <i32>(v - half + HALF)), bottom = min(height, <i32>(v + half + HALF));
    // The four pixels do not go beyond the row.
    const first = min(left, width - 4);
    const within = v128.and(i32x4.ge_s(ORDER, i32x4.splat(left - first)), i32x4.lt_s(ORDER, i32x4.splat(right - first)));
    let at = depths + (<usize>(top * width + first) << 2);
    for (let line = top; line < bottom; line += 1, at += stride) write(at, inverse, shown, within);
  }
}

function small(from: usize, to: usize): void {
  for (let entry = from; entry < to; entry += ENTRY) {
    const u = load<f32>(entry), v = load<f32>(entry, 4), half = HALF * load<f32>(entry, 12);
    const inverse = v128.load32_splat(entry, 8), shown = v128.load32_splat(entry, 16);
    const left = min(width - 8, max(0, <i32>(u - half + HALF)));
    const top = max(0, <i32>(v - half + HALF)), bottom = min(height, <i32>(v + half + HALF));
    const beside = f32x4.add(f32x4.splat(<f32>left - u), MIDDLES), reach = f32x4.splat(half * half);
    const reach1 = f32x4.sub(reach, square(beside)), reach2 = f32x4.sub(reach, square(f32x4.add(beside, f32x4.splat(4))));
    let away = f32x4.splat(<f32>top + HALF - v);
    let at = depths + (<usize>(top * width + left) << 2);
    for (let line = top; line < bottom; line += 1, at += stride) {
      const off = square(away);
      write(at, inverse, shown, f32x4.lt(off, reach1));
      write(at + 16, inverse, shown, f32x4.lt(off, reach2));
      away = f32x4.add(away, f32x4.splat(1));
    }
  }
}

function large(from: usize, to: usize): void {
  for (let entry = from; entry < to; entry += ENTRY) {
    const u = load<f32>(entry), v = load<f32>(entry, 4), inverse = load<f32>(entry, 8), half = HALF * load<f32>(entry, 12);
    const left = max(0, <i32>(u - half + HALF)), right = min(width, <i32>(u + half + HALF));
    const top = max(0, <i32>(v - half + HALF)), bottom = min(height, <i32>(v + half + HALF));
    // A disc that is hidden in its middle and at its four ends is left out.
    const middle = depths + (<usize>(<i32>v * width) << 2), column = <i32>u, arm = <i32>(ARM * half);
    const hidden = min(
      min(load<f32>(depths + (<usize>(top * width + column) << 2)), load<f32>(depths + (<usize>((bottom - 1) * width + column) << 2))),
      min(load<f32>(middle + (<usize>max(0, column - arm) << 2)), load<f32>(middle + (<usize>min(width - 1, column + arm) << 2))));
    if (inverse <= min(hidden, load<f32>(middle + (<usize>column << 2)))) continue;
    const inverse4 = f32x4.splat(inverse), shown = v128.load32_splat(entry, 16);
    const wide = (right - left + 3) & -4, first = min(left, width - wide);
    const beside = f32x4.add(f32x4.splat(<f32>first - u), MIDDLES), reach = f32x4.splat(half * half);
    let away = f32x4.splat(<f32>top + HALF - v);
    let at = depths + (<usize>(top * width + first) << 2);
    for (let line = top; line < bottom; line += 1, at += stride) {
      const rest = f32x4.sub(reach, square(away));
      let x = beside;
      for (let pixel = at, end = at + (<usize>wide << 2); pixel < end; pixel += 16) {
        write(pixel, inverse4, shown, f32x4.lt(square(x), rest));
        x = f32x4.add(x, f32x4.splat(4));
      }
      away = f32x4.add(away, f32x4.splat(1));
    }
  }
}
