// Shader of scan points: discs of the size of a point in the world, in the chosen colour.

import { ShaderMaterial, Vector2, Vector3, Vector4 } from "./vendor/three.module.min.js";
import { MODES, textures } from "./colours.js";

const VERTEX = /* glsl */ `
attribute vec3 rgb;
attribute float intensity;
attribute float classification;
attribute float scan;
uniform int uMode;
uniform float uSize;       // diameter of a point [m]
uniform float uScale;      // pixels of a metre at a distance of a metre
uniform vec2 uPixels;      // least and largest diameter
uniform vec2 uHeight;      // range of heights [m]
uniform vec2 uIntensity;   // range of intensities
uniform float uFog;        // distance at which half of the colour is left [m]
uniform vec3 uGround;      // colour of the background
uniform vec3 uUser;        // place of the user's feet
uniform vec4 uVerdict;     // its colour, and the height of the user
uniform vec4 uCut;          // place of the user's shoulders; radius of the view to it that is kept free, or 0 [m]
uniform sampler2D uHeightRamp, uIntensityRamp, uClasses, uScans;
varying vec3 vColour;

vec3 heightColour(float z) {
  float at = clamp((z - uHeight.x) / max(uHeight.y - uHeight.x, 1e-3), 0.0, 1.0);
  // Users are near the ground: there the colours change faster.
  return texture2D(uHeightRamp, vec2(pow(at, 0.7), 0.5)).rgb;
}

void main() {
  vec4 world = modelMatrix * vec4(position, 1.0);
  vec4 seen = viewMatrix * world;
  gl_Position = projectionMatrix * seen;
  gl_PointSize = clamp(uSize * uScale / max(-seen.z, 1e-3), uPixels.x, uPixels.y);
  if (uCut.w > 0.0) {
    // What is between the camera and the user, not near the user, is left out.
    vec3 line = uCut.xyz - cameraPosition;
    float whole = length(line);
    vec3 way = world.xyz - cameraPosition;
    float along = dot(way, line) / whole;
    float beside = length(way - line * (along / whole));
    if (along < whole - 0.55 && beside < uCut.w * (0.35 + 0.65 * (1.0 - along / whole))) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  }
  vec3 colour;
  if (uMode == 1) {
    colour = rgb;
  } else if (uMode == 2) {
    float at = clamp((intensity - uIntensity.x) / max(uIntensity.y - uIntensity.x, 1e-6), 0.0, 1.0);
    colour = texture2D(uIntensityRamp, vec2(at, 0.5)).rgb;
  } else if (uMode == 3) {
    colour = texture2D(uClasses, vec2((mod(classification, 256.0) + 0.5) / 256.0, 0.5)).rgb;
  } else if (uMode == 4) {
    colour = texture2D(uScans, vec2((mod(scan, 256.0) + 0.5) / 256.0, 0.5)).rgb;
  } else if (uMode == 5) {
    vec3 grey = vec3(dot(heightColour(world.z), vec3(0.3, 0.5, 0.2))) * 0.55 + 0.08;
    float up = clamp(world.z - uUser.z, 0.0, uVerdict.w);
    float away = distance(world.xyz, uUser + vec3(0.0, 0.0, up));
    colour = mix(uVerdict.rgb, grey, smoothstep(0.35, 1.4, away));
  } else {
    colour = heightColour(world.z);
  }
  float far = length(seen.xyz) / uFog;
  vColour = mix(colour, uGround, 0.72 * (1.0 - exp(-0.69 * far * far)));
}`;

const FRAGMENT = /* glsl */ `
varying vec3 vColour;
void main() {
  vec2 at = gl_PointCoord - 0.5;
  if (dot(at, at) > 0.25) discard;
  gl_FragColor = vec4(vColour, 1.0);
}`;

/** Uniforms that all materials of scan points share. */
export const shared = {
  uMode: { value: 0 },
  uScale: { value: 600 },
  uPixels: { value: new Vector2(1.6, 40) },
  uHeight: { value: new Vector2(0, 10) },
  uIntensity: { value: new Vector2(0, 1) },
  uFog: { value: 60 },
  uGround: { value: new Vector3(0.039, 0.055, 0.082) },
  uUser: { value: new Vector3(1e6, 0, 0) },
  uVerdict: { value: new Vector4(0.4, 0.8, 0.8, 1.75) },
  uCut: { value: new Vector4(0, 0, 0, 0) },
  uHeightRamp: { value: textures.height },
  uIntensityRamp: { value: textures.intensity },
  uClasses: { value: textures.classification },
  uScans: { value: textures.scan },
};

/** Return a material of points with a diameter [m]. */
export function pointsMaterial(size) {
  return new ShaderMaterial({
    name: "scan",
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    uniforms: { ...shared, uSize: { value: size } },
  });
}

/** Choose the colours of all points. */
export function setMode(name) {
  shared.uMode.value = Math.max(0, MODES.findIndex((mode) => mode.name === name));
}
