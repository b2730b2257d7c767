// Figures: the points of an avatar, each drawn as a little sphere with light from above.

import { Color, Points, ShaderMaterial, Vector3 } from "./vendor/three.module.min.js";
import { shared } from "./points_material.js";

const VERTEX = /* glsl */ `
uniform float uSize;
uniform float uScale;
uniform vec3 uLight;
varying float vLight;
void main() {
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * seen;
  gl_PointSize = max(2.0, uSize * uScale / max(-seen.z, 1e-3));
  vLight = 1.0 - uLight.z + uLight.z * clamp(position.z, 0.0, 2.0) * 0.5;
}`;

const FRAGMENT = /* glsl */ `
uniform vec3 uColour;
uniform vec3 uLight;
uniform float uOpacity;
varying float vLight;
void main() {
  vec2 at = 2.0 * gl_PointCoord - 1.0;
  float square = dot(at, at);
  if (square > 1.0) discard;
  vec3 normal = vec3(at.x, -at.y, sqrt(1.0 - square));
  float light = uLight.x + uLight.y * max(0.0, dot(normal, normalize(vec3(-0.35, 0.75, 0.6))));
  gl_FragColor = vec4(uColour * light * vLight, uOpacity);
}`;

/**
 * Return a material of figures. radius: of a point [m].  light: of the shade, added by the lamp, and
 * the share that a foot has less than a place 2 m up.  options: of three.js.
 */
export function figureMaterial({ radius, colour, light, opacity = 1, ...options }) {
  const uniforms = {
    uSize: { value: 2 * radius }, uScale: shared.uScale, uColour: { value: new Color(colour) },
    uLight: { value: new Vector3(...light) }, uOpacity: { value: opacity },
  };
  return new ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms, ...options });
}

/** Return a figure of an avatar's points. */
export function figure(geometry, material) {
  const body = new Points(geometry, material);
  body.frustumCulled = false;
  return body;
}
