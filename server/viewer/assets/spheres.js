// Bounding spheres of one level of the hierarchy, and the boxes of their voxels.

import {
  BufferAttribute, BufferGeometry, DoubleSide, IcosahedronGeometry, InstancedBufferAttribute, InstancedBufferGeometry,
  LineBasicMaterial, LineSegments, Mesh, ShaderMaterial,
} from "./vendor/three.module.min.js";

// From the smallest sphere to the largest.
const STOPS = [[255, 214, 120], [240, 128, 110], [180, 96, 200], [96, 130, 240]];
export const RAMP = `linear-gradient(90deg, ${STOPS.map((rgb) => `rgb(${rgb.join(" ")})`).join(", ")})`;
// Of more spheres each has 20 or 80 triangles instead of 320: they are smaller in the picture, too.
const FINE_UP_TO = 200, MEDIUM_UP_TO = 3000;
const EDGES = [0, 1, 2, 3, 4, 5, 6, 7, 0, 2, 1, 3, 4, 6, 5, 7, 0, 4, 1, 5, 2, 6, 3, 7];

const VERTEX = /* glsl */ `
attribute vec3 center;
attribute float radius;
attribute vec3 tint;
varying vec3 vNormal;
varying vec3 vSeen;
varying vec3 vTint;
void main() {
  vec4 seen = viewMatrix * vec4(center + radius * position, 1.0);
  vNormal = mat3(viewMatrix) * position;
  vSeen = -seen.xyz;
  vTint = tint;
  gl_Position = projectionMatrix * seen;
}`;

// Rims are dense and middles clear, as of a soap bubble: spheres behind spheres are seen.
const FRAGMENT = /* glsl */ `
varying vec3 vNormal;
varying vec3 vSeen;
varying vec3 vTint;
uniform float uDense;
void main() {
  float facing = abs(dot(normalize(vNormal), normalize(vSeen)));
  float rim = pow(1.0 - facing, 2.5);
  gl_FragColor = vec4(vTint * (0.75 + 0.5 * rim), mix(uDense, 0.75, rim));
}`;

export class BoundingSpheres {
  /** group: object for them. */
  constructor(group) {
    this.material = new ShaderMaterial({
      vertexShader: VERTEX, fragmentShader: FRAGMENT, transparent: true, depthWrite: false, side: DoubleSide,
      uniforms: { uDense: { value: 0.1 } },
    });
    this.shapes = [3, 2, 1].map((detail) => new IcosahedronGeometry(1, detail).getAttribute("position"));
    this.mesh = new Mesh(new InstancedBufferGeometry(), this.material);
    this.boxes = new LineSegments(
      new BufferGeometry(), new LineBasicMaterial({ color: 0xe6edf5, transparent: true, opacity: 0.5 }));
    for (const object of [this.mesh, this.boxes]) {
      object.frustumCulled = false;
      object.visible = false;
      group.add(object);
    }
    this.drawn = 0;
    this.version = 0;
    this.wanted = false;
  }

  /** Text that changes with what is drawn. */
  get signature() {
    return `${this.version}${this.wanted}`;
  }

  show(wanted) {
    this.wanted = wanted && this.drawn > 0;
  }

  /** Choose what the next picture has. full: all; else only what takes little time. */
  prepare(full) {
    this.mesh.visible = this.wanted && full;
    this.boxes.visible = this.wanted;
  }

  /** Take spheres and boxes of voxels. shades: radii that have the first and the last colour [m]. */
  take({ arrays: { center, radius, low, high }, shades }) {
    this.mesh.geometry.dispose();
    const count = radius.rows;
    const geometry = new InstancedBufferGeometry();
    geometry.setAttribute("position", this.shapes[count <= FINE_UP_TO ? 0 : count <= MEDIUM_UP_TO ? 1 : 2]);
    geometry.setAttribute("center", new InstancedBufferAttribute(center.array, 3));
    geometry.setAttribute("radius", new InstancedBufferAttribute(radius.array, 1));
    const tints = new Float32Array(3 * count);
    for (let k = 0; k < count; k += 1) tints.set(tint(radius.array[k], shades), 3 * k);
    geometry.setAttribute("tint", new InstancedBufferAttribute(tints, 3));
    geometry.instanceCount = count;
    this.mesh.geometry = geometry;
    // Many spheres lie behind one another: each is clearer.
    this.material.uniforms.uDense.value = count <= FINE_UP_TO ? 0.1 : 0.2;
    this.drawn = count;
    this.version += 1;
    this.frame(low, high);
  }

  frame(low, high) {
    const places = new Float32Array(3 * EDGES.length * low.rows);
    let at = 0;
    for (let row = 0; row < low.rows; row += 1) {
      for (const corner of EDGES) {
        for (let axis = 0; axis < 3; axis += 1) {
          places[at] = ((corner >> axis) & 1 ? high : low).array[3 * row + axis];
          at += 1;
        }
      }
    }
    this.boxes.geometry.dispose();
    this.boxes.geometry = new BufferGeometry();
    this.boxes.geometry.setAttribute("position", new BufferAttribute(places, 3));
  }
}

/** Return the colour of a radius, by its logarithm. */
function tint(radius, [least, greatest]) {
  const from = Math.log(Math.max(least, 1e-4)), to = Math.log(Math.max(greatest, 1e-4));
  const at = to > from ? Math.min(1, Math.max(0, (Math.log(Math.max(radius, 1e-4)) - from) / (to - from))) : 1;
  const place = at * (STOPS.length - 1), left = Math.min(Math.floor(place), STOPS.length - 2);
  return STOPS[left].map((value, k) => (value + (STOPS[left + 1][k] - value) * (place - left)) / 255);
}
