// The camera: behind the user, or at its eyes. Yaw and pitch belong to the user's view.

import { MathUtils, Vector3 } from "./vendor/three.module.min.js";

const EYES = 0.93, SHOULDERS = 0.86;
const NEAR = 1.2, FAR = 40;
// Least distance to which the scan behind the user brings the camera, and of the camera from that scan
// [m]. From nearer than this the user hides half of the picture; the camera then goes into the wall
// instead, and what is between it and the user is not drawn.
const CLOSEST = 1.6, CLEAR = 0.5;
// Least distance to the right of the user: from near, it does not hide where it goes [m].
const BESIDE = 0.3;

export class CameraRig {
  constructor(camera) {
    this.camera = camera;
    this.yaw = Math.PI / 2;
    this.pitch = -0.2;
    this.distance = 4.2;
    this.focus = new Vector3();
    this.goal = new Vector3();
    this.started = false;
    this.free = Infinity;
    this.used = this.distance;
    // What is looked at instead of the user: its place, and how far the camera is from it.
    this.watched = null;
    this.before = null;
  }

  /** Look at a place from another, both (3,) [m]; the view can be turned about it. */
  watch(eye, target) {
    const way = new Vector3(...target).sub(new Vector3(...eye));
    this.before ??= { yaw: this.yaw, pitch: this.pitch };
    this.watched = { target: new Vector3(...target), distance: way.length() };
    this.yaw = Math.atan2(way.y, way.x);
    this.pitch = Math.asin(MathUtils.clamp(way.z / way.length(), -1, 1));
    this.orbit();
  }

  /** Place the camera for what is looked at. */
  orbit() {
    const level = Math.cos(this.pitch);
    const ahead = new Vector3(Math.cos(this.yaw) * level, Math.sin(this.yaw) * level, Math.sin(this.pitch));
    this.camera.position.copy(this.watched.target).addScaledVector(ahead, -this.watched.distance);
    this.camera.lookAt(this.watched.target);
  }

  /** Look at the user again. */
  leave() {
    if (!this.watched) return;
    Object.assign(this, this.before);
    this.watched = this.before = null;
    this.started = false;
  }

  /** Return the line from the user to the camera, for the server to test. */
  boom() {
    const level = Math.cos(this.pitch);
    const back = [-Math.cos(this.yaw) * level, -Math.sin(this.yaw) * level, -Math.sin(this.pitch)];
    return { place: this.focus.toArray(), way: back, reach: this.distance + CLEAR };
  }

  /** Take how far the line from the user to the camera is free of the scan [m]. */
  bound(free) {
    this.free = Math.max(CLOSEST, free - CLEAR);
  }

  /** Turn the view by angles [rad]. */
  look(yaw, pitch) {
    this.yaw = MathUtils.euclideanModulo(this.yaw + yaw + Math.PI, 2 * Math.PI) - Math.PI;
    this.pitch = MathUtils.clamp(this.pitch + pitch, -1.45, 1.35);
  }

  /** Go nearer or farther. steps: of a wheel. */
  zoom(steps) {
    if (this.watched) {
      this.watched.distance = MathUtils.clamp(this.watched.distance * 1.12 ** steps, 0.3, FAR);
      return;
    }
    this.distance = MathUtils.clamp(this.distance * 1.12 ** steps, NEAR, FAR);
  }

  /** Look at a scene as a whole, before there is a user. */
  show(low, high) {
    const size = Math.max(...high.map((value, axis) => value - low[axis]), 1);
    this.focus.set(...low.map((value, axis) => (value + high[axis]) / 2));
    const away = 0.9 * size;
    this.camera.position.set(this.focus.x + 0.5 * away, this.focus.y - 0.8 * away, this.focus.z + 0.45 * away);
    this.camera.lookAt(this.focus);
  }

  /** Follow the user's feet. seconds: since the last picture. */
  follow(place, height, firstPerson, seconds) {
    const share = (firstPerson ? EYES : SHOULDERS) * height;
    this.goal.set(place.x, place.y, place.z + share);
    // Steps are climbed in one frame of the server: the view follows them smoothly.
    const jump = this.goal.distanceTo(this.focus) > 3;
    if (!this.started || jump) this.focus.copy(this.goal);
    else {
      this.focus.x = this.goal.x;
      this.focus.y = this.goal.y;
      this.focus.z += (this.goal.z - this.focus.z) * (1 - Math.exp(-14 * seconds));
    }
    this.started = true;
    const level = Math.cos(this.pitch);
    const ahead = new Vector3(
      Math.cos(this.yaw) * level, Math.sin(this.yaw) * level, Math.sin(this.pitch));
    this.camera.position.copy(this.focus);
    if (!firstPerson) {
      // In at once, so that no wall hides the user; out slowly.
      const wanted = Math.min(this.distance, this.free);
      this.used = wanted < this.used ? wanted : this.used + (wanted - this.used) * (1 - Math.exp(-4 * seconds));
      if (Math.abs(wanted - this.used) < 0.01) this.used = wanted;
      this.camera.position.addScaledVector(ahead, -this.used);
      // Over the shoulder: the user does not hide where it goes.
      // A high picture, as on a phone, has less room beside the user.
      const right = Math.max(BESIDE, 0.07 * this.used) * Math.min(1, this.camera.aspect);
      this.camera.position.x += Math.sin(this.yaw) * right;
      this.camera.position.y -= Math.cos(this.yaw) * right;
      const floor = place.z + 0.12;
      this.camera.position.z = Math.max(this.camera.position.z, floor);
    }
    this.camera.lookAt(this.camera.position.clone().add(ahead));
  }
}
