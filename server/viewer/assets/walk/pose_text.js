// Files of poses with times, as server/cli/input/pose_file.py reads and writes them.
//
// A walk is a list of samples {time, place, turn}: time [s] from 0 on, place in the world [m], turn as
// the unit quaternion (w, x, y, z), avatar to world.

const COLUMNS = ["t", "x", "y", "z", "qw", "qx", "qy", "qz"];
// Largest deviation of a quaternion's length from 1: a CSV file has all digits, a TUM file often four.
const CSV_WITHIN = 1e-6, TUM_WITHIN = 1e-3;
// Poses a second of a file whose times do not ascend.
const RATE = 30;

/** Return whether a file's name says that it has the format of the TUM RGB-D benchmark. */
const isTum = (name) => /\.(tum|txt)$/i.test(name);

/** Return a walk as the text of a CSV file, t,x,y,z,qw,qx,qy,qz. */
export function csvText(walk) {
  const rows = walk.map(({ time, place, turn }) => [time, ...place, ...turn].join(","));
  return `${[COLUMNS.join(","), ...rows].join("\n")}\n`;
}

/** Return a walk as the text of a TUM file, timestamp tx ty tz qx qy qz qw. */
export function tumText(walk) {
  const rows = walk.map(({ time, place, turn: [w, x, y, z] }) => [time, ...place, x, y, z, w].join(" "));
  return `${["# timestamp tx ty tz qx qy qz qw", ...rows].join("\n")}\n`;
}

/** Return the walk of a file's text. Throws an Error that names the line.
 *
 * name: of the file; its suffix selects the format.
 */
export function parseWalk(name, text) {
  const lines = text.replace(/^\uFEFF/, "").split(/\r\n|\r|\n/);
  const rows = isTum(name) ? tumRows(name, lines) : csvRows(name, lines);
  if (rows.length < 2) throw new Error(`${name}: ${rows.length} poses: expected a walk of at least two`);
  const ascends = rows.every(([time], k) => k === 0 || time > rows[k - 1][0]);
  return rows.map(([time, x, y, z, ...turn], k) => (
    { time: ascends ? time - rows[0][0] : k / RATE, place: [x, y, z], turn }));
}

function csvRows(name, lines) {
  const header = lines[0].split(",").map((each) => each.trim());
  if ([...header].sort().join() !== [...COLUMNS].sort().join()) {
    throw new Error(`${name}, line 1: columns ${header.join(",").slice(0, 80) || "missing"}: expected ${COLUMNS.join(",")}`);
  }
  const order = COLUMNS.map((column) => header.indexOf(column));
  const rows = [];
  for (let k = 1; k < lines.length; k += 1) {
    if (lines[k] === "") continue;
    const values = numbers(name, k, lines[k].split(","), COLUMNS.join(","));
    rows.push(normalised(name, k, order.map((column) => values[column]), CSV_WITHIN));
  }
  return rows;
}

function tumRows(name, lines) {
  const rows = [];
  for (const [k, line] of lines.entries()) {
    const words = line.trim().split(/\s+/);
    if (!words[0] || words[0].startsWith("#")) continue;
    const [t, x, y, z, qx, qy, qz, qw] = numbers(name, k, words, "timestamp tx ty tz qx qy qz qw");
    rows.push(normalised(name, k, [t, x, y, z, qw, qx, qy, qz], TUM_WITHIN));
  }
  return rows;
}

function numbers(name, k, words, expected) {
  if (words.length !== COLUMNS.length) {
    throw new Error(`${name}, line ${k + 1}: ${words.length} values: expected ${expected}`);
  }
  // Number("") is 0.
  const values = words.map((word) => (word.trim() === "" ? NaN : Number(word)));
  if (!values.every(Number.isFinite)) throw new Error(`${name}, line ${k + 1}: expected finite numbers`);
  return values;
}

function normalised(name, k, row, within) {
  const length = Math.hypot(...row.slice(4));
  if (Math.abs(length - 1) > within) {
    throw new Error(`${name}, line ${k + 1}: quaternion of length ${length.toPrecision(9)}: expected 1 within ${within}`);
  }
  return row.map((value, column) => (column < 4 ? value : value / length));
}

/** Return the unit quaternion (w, x, y, z) of a rotation, three rows. Divides by the largest part. */
export function quaternion(m) {
  const squares = [
    1 + m[0][0] + m[1][1] + m[2][2], 1 + m[0][0] - m[1][1] - m[2][2],
    1 - m[0][0] + m[1][1] - m[2][2], 1 - m[0][0] - m[1][1] + m[2][2],
  ];
  const k = squares.indexOf(Math.max(...squares));
  // Four times the products of part k with each of w, x, y and z.
  const products = [
    [squares[0], m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]],
    [m[2][1] - m[1][2], squares[1], m[1][0] + m[0][1], m[0][2] + m[2][0]],
    [m[0][2] - m[2][0], m[1][0] + m[0][1], squares[2], m[2][1] + m[1][2]],
    [m[1][0] - m[0][1], m[0][2] + m[2][0], m[2][1] + m[1][2], squares[3]],
  ][k];
  const length = Math.hypot(...products);
  return products.map((value) => value / length);
}
