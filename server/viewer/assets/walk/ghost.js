// A walk that is played back: a pale figure on its way, which the server knows nothing of.

import {
  BufferGeometry, Float32BufferAttribute, Line, LineBasicMaterial, Matrix4, Quaternion, Vector3,
} from "../vendor/three.module.min.js";
import { Avatar } from "../avatar.js";

const COLOUR = [0.78, 0.84, 0.95];
// The line lies this far over the ground, and leaves out places nearer than `APART` to the last [m].
const OVER = 0.04, APART = 0.05;

export class Ghost {
  /** app: gives the figure's shape and the page's frame. */
  constructor(app) {
    this.app = app;
    this.walk = null;
    this.time = 0;
    this.speed = 1;
    this.playing = false;
    this.avatar = null;
    this.line = null;
    this.at = 0;
    this.before = 0;
    this.changed = () => {};
  }

  get seconds() {
    return this.walk?.at(-1).time ?? 0;
  }

  /** Take another walk, or null, and stand at its beginning. */
  show(walk) {
    this.walk = walk;
    this.time = 0;
    this.at = 0;
    this.playing = false;
    this.drop();
    this.changed();
  }

  /** Play, from the beginning after the end, or pause. */
  toggle() {
    if (!this.walk) return;
    if (!this.playing && this.time >= this.seconds) this.time = 0;
    this.playing = !this.playing;
    this.changed();
  }

  /** Go to a time of the walk [s]. */
  seek(time) {
    this.time = Math.min(this.seconds, Math.max(0, time));
    this.changed();
  }

  /** Move for a picture. now: [ms]. */
  update(now) {
    const passed = (now - this.before) / 1000;
    this.before = now;
    if (!this.walk) return;
    if (this.playing) {
      this.time = Math.min(this.seconds, this.time + this.speed * passed);
      if (this.time >= this.seconds) this.playing = false;
      this.changed();
    }
    const { users, origin } = this.app;
    if (!origin || !users.geometry) return;
    // A scene that returns may have another frame and another figure.
    if (this.origin !== origin || this.geometry !== users.geometry) this.drop();
    if (!this.avatar) this.make();
    this.place();
  }

  make() {
    const { users, origin, axes, view } = this.app;
    this.origin = origin;
    this.geometry = users.geometry;
    const rows = axes.map((axis) => new Vector3(...axis));
    this.toFrame = (place) => {
      const away = new Vector3(...place.map((value, k) => value - origin[k]));
      return new Vector3(...rows.map((row) => row.dot(away)));
    };
    const [x, y, z] = axes;
    this.turn = new Quaternion().setFromRotationMatrix(new Matrix4().set(...x, 0, ...y, 0, ...z, 0, 0, 0, 0, 1));
    this.avatar = new Avatar(users.geometry, users.radius, view.points);
    this.avatar.paint(COLOUR);
    const places = [];
    for (const { place } of this.walk) {
      const next = this.toFrame(place);
      if (!places.length || places.at(-1).distanceTo(next) > APART) places.push(next);
    }
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new Float32BufferAttribute(places.flatMap(({ x, y, z }) => [x, y, z + OVER]), 3));
    this.line = new Line(geometry, new LineBasicMaterial({ transparent: true, opacity: 0.7 }));
    this.line.material.color.setRGB(...COLOUR);
    this.line.frustumCulled = false;
    view.lines.add(this.line);
  }

  /** Put the figure where the walk is at the present time, between two samples. */
  place() {
    const { walk, time } = this;
    if (walk[this.at].time > time) this.at = 0;
    while (this.at < walk.length - 2 && walk[this.at + 1].time <= time) this.at += 1;
    const [from, to] = [walk[this.at], walk[this.at + 1]];
    const share = Math.min(1, Math.max(0, (time - from.time) / (to.time - from.time)));
    const rotation = ({ turn: [w, x, y, z] }) => new Quaternion(x, y, z, w);
    const { position, turn, object } = this.avatar;
    position.lerpVectors(this.toFrame(from.place), this.toFrame(to.place), share);
    turn.slerpQuaternions(rotation(from), rotation(to), share).premultiply(this.turn);
    object.position.copy(position);
    object.quaternion.copy(turn);
  }

  /** Return where the figure is in the world [m], or null. */
  worldPlace() {
    if (!this.avatar) return null;
    const { axes, origin } = this.app;
    const parts = this.avatar.position.toArray();
    return origin.map((value, k) => value + parts.reduce((sum, part, row) => sum + part * axes[row][k], 0));
  }

  /** Return a text that changes with what is drawn. */
  get signature() {
    return this.avatar ? this.avatar.signature : "";
  }

  drop() {
    this.avatar?.remove();
    this.avatar = null;
    if (!this.line) return;
    this.app.view.lines.remove(this.line);
    this.line.geometry.dispose();
    this.line.material.dispose();
    this.line = null;
  }
}
