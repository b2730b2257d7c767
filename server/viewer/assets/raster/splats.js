// The inner loop: points of a tile into a picture.

// Up to the first diameter a point is four pixels, up to the second a square of a disc's area; above, a
// disc [pixels].
const FOUR = 2.6, SQUARE = 4.5;
// Side of such a square, as a share of the diameter, and half of it.
const HALF_SIDE = Math.sqrt(Math.PI) / 4;

/** Steps of the fog's table, for squares of distances up to `FOG_END` times the fog's. */
export const FOG_STEPS = 1024, FOG_END = 8;

/** Draw points; return how many were inside of the picture.
 *
 * picture: see picture.js.  places: (n, 3) as one array of uint16.  colours: of points.  from, to: first
 * point, and the one after the last.  screen: 12 numbers, rows for x, y (times w, pixels) and w of a place.  size:
 * diameter at w = 1 [pixels].  least, most: of diameters [pixels].  near: least w.  eye: place of the
 * camera in the tile's frame, and the square of the frame's step over that of the fog's distance.
 * fog: `shares` of the ground's colour, by square of the distance; `redBlue` and `green`: those
 * shares of it.  cut: what is left out around the line from the camera to the user: metres along the line for a
 * step in x, y and z; the square of a step [m]; the length of what is left out [m], its radius at the camera [m],
 * and how much narrower it is a metre away.
 */
export function splat(picture, places, colours, from, to, screen, size, least, most, near, eye, fog, cut) {
  const { depth, colour, width, height } = picture;
  const a = screen[0], b = screen[1], c = screen[2], d = screen[3], e = screen[4], f = screen[5];
  const g = screen[6], h = screen[7], p = screen[8], q = screen[9], r = screen[10], s = screen[11];
  const [eyeX, eyeY, eyeZ, foggy] = eye;
  const { shares, redBlue, green } = fog;
  const [cutX, cutY, cutZ, scaled, limit, radius, narrowing] = cut;
  const steps = FOG_STEPS / FOG_END;
  const lastColumn = width - 1, lastRow = height - 1;
  let inside = 0;
  for (let row = from, at = 3 * from; row < to; row += 1, at += 3) {
    const x = places[at], y = places[at + 1], z = places[at + 2];
    const w = p * x + q * y + r * z + s;
    if (w < near) continue;
    const inverse = 1 / w;
    const u = (a * x + b * y + c * z + d) * inverse, v = (e * x + f * y + g * z + h) * inverse;
    if (!(u >= 0 && u < width && v >= 0 && v < height)) continue;
    const dx = x - eyeX, dy = y - eyeY, dz = z - eyeZ, square = dx * dx + dy * dy + dz * dz;
    const along = cutX * dx + cutY * dy + cutZ * dz;
    if (along < limit) {
      const wide = radius - narrowing * along;
      if (scaled * square - along * along < wide * wide) continue;
    }
    inside += 1;
    let diameter = size * inverse;
    if (diameter < least) diameter = least;
    else if (diameter > most) diameter = most;
    const step = (foggy * square * steps) | 0;
    const fogged = step < FOG_STEPS ? step : FOG_STEPS - 1;
    const rest = 256 - shares[fogged];
    const own = colours[row];
    const outer = (Math.imul(own & 0xff00ff, rest) + redBlue[fogged]) >>> 8;
    const inner = (Math.imul((own >>> 8) & 0xff, rest) + green[fogged]) >>> 8;
    const shown = 0xff000000 | (outer & 0xff00ff) | (inner << 8);
    if (diameter <= FOUR) {
      const left = (u - 0.5) | 0, top = (v - 0.5) | 0;
      if (left < lastColumn && top < lastRow) {
        const upper = top * width + left, lower = upper + width;
        if (inverse > depth[upper]) {
          depth[upper] = inverse;
          colour[upper] = shown;
        }
        if (inverse > depth[upper + 1]) {
          depth[upper + 1] = inverse;
          colour[upper + 1] = shown;
        }
        if (inverse > depth[lower]) {
          depth[lower] = inverse;
          colour[lower] = shown;
        }
        if (inverse > depth[lower + 1]) {
          depth[lower + 1] = inverse;
          colour[lower + 1] = shown;
        }
      }
    } else if (diameter <= SQUARE) {
      const half = HALF_SIDE * diameter;
      let left = (u - half + 0.5) | 0, right = (u + half + 0.5) | 0;
      let top = (v - half + 0.5) | 0, bottom = (v + half + 0.5) | 0;
      if (left < 0) left = 0;
      if (top < 0) top = 0;
      if (right > width) right = width;
      if (bottom > height) bottom = height;
      for (let line = top * width; top < bottom; top += 1, line += width) {
        for (let pixel = line + left, end = line + right; pixel < end; pixel += 1) {
          if (inverse > depth[pixel]) {
            depth[pixel] = inverse;
            colour[pixel] = shown;
          }
        }
      }
    } else {
      const half = 0.5 * diameter, whole = half * half;
      let top = (v - half + 0.5) | 0, bottom = (v + half + 0.5) | 0;
      if (top < 0) top = 0;
      if (bottom > height) bottom = height;
      // A disc that is hidden in its middle and at its four ends is left out: of all pixels that would be
      // looked at, half are hidden.
      const middle = (v | 0) * width, column = u | 0, arm = (0.9 * half) | 0;
      if (inverse <= depth[middle + column]
        && inverse <= depth[top * width + column] && inverse <= depth[(bottom - 1) * width + column]
        && inverse <= depth[middle + (column > arm ? column - arm : 0)]
        && inverse <= depth[middle + (column + arm < width ? column + arm : lastColumn)]) continue;
      for (let line = top * width; top < bottom; top += 1, line += width) {
        const away = top + 0.5 - v;
        const reach = whole - away * away;
        if (reach <= 0) continue;
        const side = Math.sqrt(reach);
        const first = (u - side + 0.5) | 0;
        let right = (u + side + 0.5) | 0;
        if (right > width) right = width;
        for (let pixel = line + (first > 0 ? first : 0), end = line + right; pixel < end; pixel += 1) {
          if (inverse > depth[pixel]) {
            depth[pixel] = inverse;
            colour[pixel] = shown;
          }
        }
      }
    }
  }
  return inside;
}

/** Return the tables of the fog. ground: its colour, red, green, blue, 0 to 1. */
export function fogTables([red, green, blue]) {
  const shares = new Int32Array(FOG_STEPS), redBlue = new Int32Array(FOG_STEPS), greens = new Int32Array(FOG_STEPS);
  const [r, g, b] = [red, green, blue].map((value) => Math.round(255 * value));
  for (let k = 0; k < FOG_STEPS; k += 1) {
    // The middle of a step; the formula of points_material.js.
    const square = ((k + 0.5) * FOG_END) / FOG_STEPS;
    shares[k] = Math.round(256 * 0.72 * (1 - Math.exp(-0.69 * square)));
    redBlue[k] = shares[k] * ((b << 16) | r);
    greens[k] = shares[k] * g;
  }
  return { shares, redBlue, green: greens };
}
