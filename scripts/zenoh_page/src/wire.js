// Messages of solidcloud's wire, version 1, as JSON: what this page needs of schemas/WIRE.md.

export const ENCODING = "application/json";
/** Verdicts by their number. */
export const VERDICTS = ["clear", "contact", "unknown"];
const NAME = /^[A-Za-z0-9._-]{1,64}$/;

/**
 * @typedef {{name: string, points: number, radius: number, bounding_radius: number, inner_points: number, description: string}} AvatarInfo
 * @typedef {{scene: string, points: number, voxels: number, radius: number, bounds: number[][]}} SceneInfo
 * @typedef {{
 *   verdict: string[], outside: boolean[], voxelsMissing: number[], nodeVisits: number[],
 *   pointTests: number[], engineSeconds: number, faults: string[],
 * }} CollideAnswers
 */

/** An answer of the server that says why there is none. */
export class WireError extends Error {
  /** @param {string} code @param {string} message */
  constructor(code, message) {
    super(message);
    this.code = code;
  }
}

/** Return a new secret name of a client: 128 random bits in hex. @returns {string} */
export function newClient() {
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Return the key of a question. @param {string} scene @param {string} client @param {string} question */
export function questionKey(scene, client, question) {
  return `solidcloud/1/scene/${named(scene)}/${named(client)}/${question}`;
}

/** Return the key of a client's liveliness token. @param {string} scene @param {string} client */
export function tokenKey(scene, client) {
  return `solidcloud/1/client/${named(scene)}/${named(client)}`;
}

/** @param {string} name */
function named(name) {
  if (!NAME.test(name)) throw new RangeError(`${name || "an empty name"}: expected 1 to 64 of A-Z a-z 0-9 . _ -`);
  return name;
}

/**
 * Return the pose, avatar to world, of an avatar upright at a place.
 * @param {number[]} place x, y, z [m]
 * @param {number} turn about the z axis, counterclockwise seen from above [degrees]
 */
export function uprightPose([x, y, z], turn) {
  const angle = (turn * Math.PI) / 180, c = Math.cos(angle), s = Math.sin(angle);
  return [[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]];
}

/**
 * Return the points of a figure of this height, a column of spheres. Its feet are at 0.
 * @param {number} height [m] @param {number} radius of the spheres [m]
 */
export function columnPoints(height, radius) {
  const count = Math.max(2, Math.ceil((height - 2 * radius) / radius) + 1);
  return Array.from({ length: count }, (_, k) => [0, 0, radius + ((height - 2 * radius) * k) / (count - 1)]);
}

/** Return AddAvatarRequest. @param {string} name @param {number[][]} points (n, 3) @param {number} radius [m] */
export function addAvatarRequest(name, points, radius) {
  return text({ name, points, radius });
}

/** Return CollideRequest. @param {string} avatar @param {number[][][]} poses (k, 4, 4) @param {number} margin [m] */
export function collideRequest(avatar, poses, margin = 0) {
  return text({ avatar, poses, margin });
}

/** Return JSON. It has no NaN and infinities: JSON.stringify would write null. @param {object} message */
function text(message) {
  return JSON.stringify(message, (name, value) => {
    if (typeof value === "number" && !Number.isFinite(value)) throw new RangeError(`${value}: expected finite numbers`);
    return value;
  });
}

/** Return SceneInfo. @param {string} answer @returns {SceneInfo} */
export function readSceneInfo(answer) {
  const { scene, points, voxels, radius, bounds } = JSON.parse(answer);
  return { scene, points, voxels, radius, bounds };
}

/** Return AvatarInfo. @param {string} answer @returns {AvatarInfo} */
export function readAvatarInfo(answer) {
  return JSON.parse(answer);
}

/**
 * Return CollideAnswers. Throws for a verdict that is none, and for another number of answers than poses.
 * @param {string} answer @param {number} poses
 * @returns {CollideAnswers}
 */
export function readCollideAnswers(answer, poses) {
  const found = JSON.parse(answer);
  for (const name of ["verdict", "outside", "voxels_missing", "node_visits", "point_tests"]) {
    if (!Array.isArray(found[name]) || found[name].length !== poses) {
      throw new WireError("internal", `${name}: expected one for each of ${poses} poses`);
    }
  }
  return {
    verdict: found.verdict.map(verdictName),
    outside: found.outside.map(Boolean),
    voxelsMissing: found.voxels_missing,
    nodeVisits: found.node_visits,
    pointTests: found.point_tests,
    engineSeconds: found.engine_seconds ?? 0,
    faults: found.faults ?? [],
  };
}

/** @param {number} verdict */
function verdictName(verdict) {
  const name = VERDICTS[verdict];
  if (name === undefined) throw new WireError("internal", `verdict ${verdict}: expected 0, 1 or 2`);
  return name;
}

/** Return the error of an error reply. encoding: of the reply. @param {string} encoding @param {string} payload */
export function readError(encoding, payload) {
  // A seal may follow the encoding. Any other encoding is that of zenoh's own errors.
  if (encoding.split(";")[0] !== ENCODING) return new WireError("zenoh", payload);
  const { code, message } = JSON.parse(payload);
  return new WireError(code, message);
}
