// Colours of points: ramps and palettes, as textures for the shader and as gradients for the panel.

import { ClampToEdgeWrapping, DataTexture, LinearFilter, NearestFilter, RGBAFormat } from "./vendor/three.module.min.js";

/** Ways to colour the scan: name, title, and the column that the archive must keep. */
export const MODES = [
  { name: "height", title: "Height" },
  { name: "rgb", title: "Colour of the scan", column: "rgb" },
  { name: "intensity", title: "Intensity", column: "intensity" },
  { name: "classification", title: "Classification", column: "classification" },
  { name: "scan", title: "Scan", column: "scan" },
  { name: "verdict", title: "Verdict around the user" },
];

export const VERDICTS = {
  clear: [0x5f, 0xd3, 0xc4], stopped: [0xf2, 0xb8, 0x4b], contact: [0xff, 0x6b, 0x5e], unknown: [0xb7, 0x9c, 0xff],
};

// Light over dark, from a deep blue to a warm white: order is seen without colour, too.
const HEIGHT = [[74, 88, 158], [52, 124, 178], [56, 168, 172], [134, 204, 152], [234, 212, 140], [252, 240, 220]];
const GREY = [[34, 38, 46], [128, 136, 148], [250, 250, 246]];
// Okabe and Ito's colours, which people with any kind of colour vision tell apart.
const PALETTE = [
  [86, 180, 233], [230, 159, 0], [0, 158, 115], [240, 228, 66], [204, 121, 167], [213, 94, 0], [0, 114, 178], [200, 206, 214],
];
// ASPRS classes 0 to 18: ground, vegetation, building, water and so on.
const CLASSES = {
  0: [130, 140, 152], 1: [150, 158, 168], 2: [184, 142, 96], 3: [158, 208, 112], 4: [104, 178, 88], 5: [52, 136, 72],
  6: [226, 122, 92], 7: [255, 64, 160], 9: [74, 150, 232], 10: [180, 96, 200], 11: [120, 124, 140], 17: [204, 188, 120],
};

function ramp(stops, at) {
  const place = at * (stops.length - 1);
  const left = Math.min(Math.floor(place), stops.length - 2);
  return stops[left].map((value, k) => value + (stops[left + 1][k] - value) * (place - left));
}

function texture(colour, filter) {
  const data = new Uint8Array(256 * 4);
  for (let k = 0; k < 256; k += 1) data.set([...colour(k).map(Math.round), 255], 4 * k);
  const made = new DataTexture(data, 256, 1, RGBAFormat);
  made.minFilter = made.magFilter = filter;
  made.wrapS = made.wrapT = ClampToEdgeWrapping;
  made.needsUpdate = true;
  return made;
}

export const textures = {
  height: texture((k) => ramp(HEIGHT, k / 255), LinearFilter),
  intensity: texture((k) => ramp(GREY, k / 255), LinearFilter),
  classification: texture((k) => CLASSES[k] ?? PALETTE[k % PALETTE.length], NearestFilter),
  scan: texture((k) => PALETTE[k % PALETTE.length], NearestFilter),
};

const css = (stops) => `linear-gradient(90deg, ${stops.map((rgb) => `rgb(${rgb.join(" ")})`).join(", ")})`;
export const gradients = { height: css(HEIGHT), intensity: css(GREY) };
export const scanColour = (k) => `rgb(${PALETTE[k % PALETTE.length].join(" ")})`;
