// Runs of a tile's points that may be in the picture.
//
// Points of one detail are in the order of the hierarchy, so that consecutive ones are near each other. A
// tile is 8 m wide and the camera is in it, or beside it: most of its points are outside of the picture.

const LENGTH = 256;

/** Return the boxes of runs of points, (k, 6) as one array: middles and halves. places: (n, 3) as one array. */
export function boxesOf(places) {
  const count = places.length / 3, runs = Math.ceil(count / LENGTH);
  const boxes = new Float32Array(6 * runs);
  for (let run = 0; run < runs; run += 1) {
    for (let axis = 0; axis < 3; axis += 1) {
      let low = Infinity, high = -Infinity;
      for (let at = 3 * LENGTH * run + axis, end = 3 * Math.min(count, LENGTH * (run + 1)); at < end; at += 3) {
        const value = places[at];
        if (value < low) low = value;
        if (value > high) high = value;
      }
      boxes[6 * run + axis] = (low + high) / 2;
      boxes[6 * run + 3 + axis] = (high - low) / 2;
    }
  }
  return boxes;
}

/** Return begins and ends of the runs of the first `count` points that may be in the picture, joined where they meet. */
export function seenRuns(boxes, count, screen, width, height, near) {
  const [a, b, c, d, e, f, g, h, p, q, r, s] = screen;
  const planes = [
    [a, b, c, d], [width * p - a, width * q - b, width * r - c, width * s - d],
    [e, f, g, h], [height * p - e, height * q - f, height * r - g, height * s - h], [p, q, r, s - near],
  ];
  const found = [];
  for (let run = 0; LENGTH * run < count; run += 1) {
    let seen = true;
    for (let k = 0; k < 5 && seen; k += 1) {
      const plane = planes[k];
      let most = plane[3];
      for (let axis = 0; axis < 3; axis += 1) {
        most += plane[axis] * boxes[6 * run + axis] + Math.abs(plane[axis]) * boxes[6 * run + 3 + axis];
      }
      seen = most >= 0;
    }
    if (!seen) continue;
    const end = Math.min(count, LENGTH * (run + 1));
    if (found.at(-1) === LENGTH * run) found[found.length - 1] = end;
    else found.push(LENGTH * run, end);
  }
  return found;
}
