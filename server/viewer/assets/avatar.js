// Users as the server last reported them: little spheres in the colour of their verdict.

import {
  BufferAttribute, BufferGeometry, DoubleSide, Group, Matrix4, Mesh, MeshBasicMaterial, Quaternion, RingGeometry, Vector3,
} from "./vendor/three.module.min.js";
import { figure, figureMaterial } from "./figure.js";
import { VERDICTS } from "./colours.js";

/** Interval between two states of the server [ms]: the picture is one behind, and moves evenly. */
const FRAME_MS = 1000 / 30;

export class Avatar {
  constructor(geometry, radius, group) {
    this.group = group;
    this.material = figureMaterial({ name: "figure", radius, light: [0.42, 0.62, 0.18] });
    this.object = new Group();
    this.body = figure(geometry, this.material);
    this.ring = new Mesh(
      new RingGeometry(0.34, 0.4, 48), new MeshBasicMaterial({ side: DoubleSide, transparent: true, opacity: 0.85 }));
    this.ring.position.z = 0.012;
    this.object.add(this.body, this.ring);
    group.add(this.object);
    this.poses = [];
    this.position = new Vector3();
    this.turn = new Quaternion();
    this.verdict = "";
  }

  /** Take a pose, rows of a matrix. now: [ms]. */
  move(pose, verdict, now) {
    const turn = new Quaternion().setFromRotationMatrix(new Matrix4().set(...pose.flat()));
    const place = new Vector3(pose[0][3], pose[1][3], pose[2][3]);
    const last = this.poses.at(-1);
    if (last && last.place.distanceTo(place) > 2) this.poses = [];
    this.poses.push({ place, turn, now });
    this.poses = this.poses.slice(-2);
    if (verdict !== this.verdict) {
      this.verdict = verdict;
      const [r, g, b] = VERDICTS[verdict] ?? VERDICTS.unknown;
      this.paint([r / 255, g / 255, b / 255]);
    }
  }

  /** Draw in a colour, (3,) from 0 to 1. */
  paint(colour) {
    this.material.uniforms.uColour.value.setRGB(...colour);
    this.ring.material.color.setRGB(...colour);
  }

  /** Place the body between its last two poses. */
  update(now) {
    const [from, to] = [this.poses[0], this.poses.at(-1)];
    if (!to) return;
    const share = from === to ? 1 : Math.min(1, Math.max(0, (now - to.now) / FRAME_MS));
    this.position.lerpVectors(from.place, to.place, share);
    this.turn.slerpQuaternions(from.turn, to.turn, share);
    this.object.position.copy(this.position);
    this.object.quaternion.copy(this.turn);
  }

  get signature() {
    const numbers = [...this.position.toArray(), ...this.turn.toArray()].map((value) => value.toFixed(5));
    return [...numbers, this.verdict, this.object.visible].join();
  }

  remove() {
    this.group.remove(this.object);
    this.material.dispose();
    this.ring.geometry.dispose();
    this.ring.material.dispose();
  }
}

export class Users {
  /** group: object for the bodies. */
  constructor(group) {
    this.group = group;
    this.geometry = null;
    this.own = null;
    this.others = new Map();
    this.height = 1.75;
  }

  /** Take the points of the avatar, which all users of this viewer have. */
  shape({ arrays, radius }) {
    this.leave();
    this.geometry?.dispose();
    const { array, rows } = arrays.points;
    this.geometry = new BufferGeometry();
    this.geometry.setAttribute("position", new BufferAttribute(array, 3));
    this.geometry.computeBoundingBox();
    const box = this.geometry.boundingBox;
    this.height = Math.max(0.2, box.max.z);
    // Large enough to close the surface of a body with this many points.
    const size = box.getSize(new Vector3());
    const area = 2 * (size.x * size.y + size.y * size.z + size.z * size.x);
    this.radius = Math.max(radius, 0.85 * Math.sqrt((0.55 * area) / Math.max(1, rows)));
  }

  /** Take a frame: the own state, and the others'. */
  frame({ state, others }, verdict, names, now) {
    if (!this.geometry) return;
    this.own ??= new Avatar(this.geometry, this.radius, this.group);
    this.own.move(state.pose, verdict, now);
    const seen = new Set();
    for (const { number, pose, verdict: code } of others) {
      seen.add(number);
      if (!this.others.has(number)) this.others.set(number, new Avatar(this.geometry, this.radius, this.group));
      this.others.get(number).move(pose, names[code] ?? "unknown", now);
    }
    for (const [number, avatar] of this.others) {
      if (!seen.has(number)) {
        avatar.remove();
        this.others.delete(number);
      }
    }
  }

  /** Return a text that changes with what is drawn. */
  get signature() {
    return [this.own, ...this.others.values()]
      .map((each) => (each ? each.signature : ""))
      .join(";");
  }

  update(now, firstPerson) {
    for (const avatar of this.others.values()) avatar.update(now);
    this.own?.update(now);
    if (this.own) this.own.object.visible = !firstPerson;
  }

  leave() {
    for (const avatar of [this.own, ...this.others.values()]) avatar?.remove();
    this.own = null;
    this.others.clear();
  }
}
