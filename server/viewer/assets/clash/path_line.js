// The path of the avatar's middle, as a band that faces the camera, coloured by clearance.

import {
  DoubleSide, Float32BufferAttribute, InstancedBufferAttribute, InstancedBufferGeometry, Mesh, ShaderMaterial,
} from "../vendor/three.module.min.js";
import { shared } from "../points_material.js";
import { CLASSES, classOf } from "./clearance.js";

// A longer path is drawn with this many pieces, each in the colour of its worst pose or motion.
const MOST_PIECES = 3000;
const RADIUS = 0.02;

const VERTEX = /* glsl */ `
attribute vec3 begin;
attribute vec3 end;
attribute vec3 tint;
uniform float uScale;
varying vec3 vTint;
varying float vSide;
void main() {
  vec3 from = (modelViewMatrix * vec4(begin, 1.0)).xyz;
  vec3 to = (modelViewMatrix * vec4(end, 1.0)).xyz;
  float length_ = distance(from, to);
  vec3 along = length_ > 1e-5 ? (to - from) / length_ : vec3(1.0, 0.0, 0.0);
  vec3 at = mix(from, to, position.x);
  float radius = max(${RADIUS}, 1.6 * max(-at.z, 0.0) / uScale);
  vec3 side = cross(along, normalize(-at));
  side = dot(side, side) > 1e-8 ? normalize(side) : vec3(0.0, 1.0, 0.0);
  // Pieces overlap a little, so that bends have no gaps.
  at += side * position.y * radius + along * (2.0 * position.x - 1.0) * 0.6 * radius;
  gl_Position = projectionMatrix * vec4(at, 1.0);
  vTint = tint;
  vSide = position.y;
}`;

const FRAGMENT = /* glsl */ `
uniform float uOpacity;
varying vec3 vTint;
varying float vSide;
void main() {
  gl_FragColor = vec4(vTint * (0.5 + 0.5 * sqrt(max(0.0, 1.0 - vSide * vSide))), uOpacity);
}`;

export class PathLine {
  /** group: object for the line. */
  constructor(group) {
    this.group = group;
    this.meshes = [];
    this.version = 0;
    this.near = 0.02;
    this.clear();
  }

  clear() {
    for (const mesh of this.meshes) {
      this.group.remove(mesh);
      mesh.material.dispose();
    }
    this.meshes[0]?.geometry.dispose();
    this.meshes = [];
    this.verdicts = new Uint8Array(0);
    this.distances = new Float32Array(0);
    this.counts = CLASSES.map(() => 0);
    this.version += 1;
  }

  /** Show a path. places: (k, 3) as one array [m]. */
  show(places) {
    this.clear();
    const total = places.length / 3;
    this.verdicts = new Uint8Array(total).fill(255);
    this.distances = new Float32Array(total).fill(Infinity);
    // Of the motion that ends at each pose.
    this.motionVerdicts = new Uint8Array(total).fill(255);
    this.motionClearances = new Float32Array(total).fill(Infinity);
    const pieces = Math.max(1, Math.min(total - 1, MOST_PIECES));
    const node = (k) => Math.round((k * (total - 1)) / pieces);
    this.ends = Array.from({ length: pieces + 1 }, (_, k) => node(k));
    const begins = new Float32Array(3 * pieces), stops = new Float32Array(3 * pieces);
    for (let k = 0; k < pieces; k += 1) {
      begins.set(places.subarray(3 * this.ends[k], 3 * this.ends[k] + 3), 3 * k);
      stops.set(places.subarray(3 * this.ends[k + 1], 3 * this.ends[k + 1] + 3), 3 * k);
    }
    const geometry = new InstancedBufferGeometry();
    geometry.setAttribute("position", new Float32BufferAttribute([0, -1, 0, 1, -1, 0, 1, 1, 0, 0, 1, 0], 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    geometry.setAttribute("begin", new InstancedBufferAttribute(begins, 3));
    geometry.setAttribute("end", new InstancedBufferAttribute(stops, 3));
    geometry.setAttribute("tint", new InstancedBufferAttribute(new Float32Array(3 * pieces), 3));
    geometry.instanceCount = pieces;
    // What is behind the scan is seen faintly.
    for (const [opacity, depthTest] of [[0.3, false], [1, true]]) {
      const mesh = new Mesh(geometry, new ShaderMaterial({
        vertexShader: VERTEX, fragmentShader: FRAGMENT, transparent: true, depthTest, depthWrite: depthTest, side: DoubleSide,
        uniforms: { uScale: shared.uScale, uOpacity: { value: opacity } },
      }));
      mesh.frustumCulled = false;
      mesh.renderOrder = depthTest ? 2 : 1;
      this.group.add(mesh);
      this.meshes.push(mesh);
    }
    this.colour();
  }

  /** Take the clearance of poses from `first` on, and of the motions that end at them. */
  take(first, { distance, verdict, motion_clearance: clearance, motion_verdict: motion }) {
    if (!this.meshes.length || first + verdict.array.length > this.verdicts.length) return;
    this.distances.set(distance.array, first);
    this.verdicts.set(verdict.array, first);
    this.motionClearances.set(clearance.array, first);
    this.motionVerdicts.set(motion.array, first);
    this.colour();
  }

  /** Colour all pieces. near: distance below which a pose counts as near [m]. */
  colour(near = this.near) {
    this.near = near;
    if (!this.meshes.length) return;
    const classes = Uint8Array.from(this.verdicts, (verdict, k) => classOf(verdict, this.distances[k], near));
    this.counts = CLASSES.map(() => 0);
    for (const each of classes) this.counts[each] += 1;
    const motions = Uint8Array.from(this.motionVerdicts, (verdict, k) => classOf(verdict, this.motionClearances[k], near));
    const { tint } = this.meshes[0].geometry.attributes;
    for (let k = 0; k + 1 < this.ends.length; k += 1) {
      let worst = CLASSES.length - 1;
      for (let pose = this.ends[k]; pose <= this.ends[k + 1]; pose += 1) {
        worst = Math.min(worst, classes[pose], pose > this.ends[k] ? motions[pose] : worst);
      }
      tint.array.set(CLASSES[worst].colour.map((part) => part / 255), 3 * k);
    }
    tint.needsUpdate = true;
    this.version += 1;
  }
}
