// How a pose of a path, or a motion between two poses, is coloured: by its clearance.

export const REACH = 1;

/** Classes of poses, worst first, with the colour and the words of the legend. */
export const CLASSES = [
  { name: "contact", colour: [255, 107, 94], text: () => "in contact, at most 0 m" },
  { name: "unknown", colour: [158, 166, 178], text: () => "unknown" },
  { name: "near", colour: [242, 184, 75], text: (near) => `near, below ${near.toFixed(2)} m` },
  { name: "clear", colour: [95, 211, 196], text: (near) => `clear, from ${near.toFixed(2)} m` },
  { name: "pending", colour: [78, 94, 118], text: () => "not examined yet" },
];
const [CONTACT, UNKNOWN, NEAR, CLEAR, PENDING] = CLASSES.keys();

/** Return the class of a pose or a motion, a number in CLASSES. verdict: 255 before its answer.  near: [m]. */
export function classOf(verdict, distance, near) {
  if (verdict === 255) return PENDING;
  if (verdict === 1) return CONTACT;
  if (verdict !== 0) return UNKNOWN;
  return distance < near ? NEAR : CLEAR;
}
