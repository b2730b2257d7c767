// Messages of the process, as server/viewer/DESIGN.md describes them.

export const VERSION = 1;

const KINDS = {
  u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, i4: Int32Array, f4: Float32Array, f8: Float64Array,
};

/** Return a binary message: its header, with `arrays` as typed arrays on the bytes of the message. */
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const begin = 4 + length;
  for (const [name, [kind, shape, first]] of Object.entries(header.arrays)) {
    const count = shape.reduce((product, axis) => product * axis, 1);
    const array = new KINDS[kind](buffer, begin + first, count);
    header.arrays[name] = { array, rows: shape[0], columns: shape[1] ?? 1 };
  }
  return header;
}
