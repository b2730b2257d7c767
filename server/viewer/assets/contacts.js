// Where the user touches the scan: contact points, contact normals, and the line to the nearest point.

import {
  BufferAttribute, BufferGeometry, ConeGeometry, CylinderGeometry, Group, LineBasicMaterial, LineSegments, Mesh,
  MeshBasicMaterial, SphereGeometry, Vector3,
} from "./vendor/three.module.min.js";

const MOST = 8, LENGTH = 0.34;
// How long a contact stays visible after the last frame that reported it [ms].
const STAY_MS = 350;
const COLOURS = { contact: 0xff6b5e, unknown: 0xb79cff, line: 0xf2b84b };

export class Contacts {
  /** group: object for the marks. */
  constructor(group) {
    this.group = group;
    const shaft = new CylinderGeometry(0.008, 0.008, LENGTH, 8).translate(0, LENGTH / 2, 0);
    const head = new ConeGeometry(0.026, 0.08, 12).translate(0, LENGTH + 0.03, 0);
    this.materials = Object.fromEntries(["contact", "unknown"].map((name) => [name, new MeshBasicMaterial({
      // Contacts are inside walls and behind the user: they are drawn over both.
      color: COLOURS[name], depthTest: false, transparent: true, opacity: 0.95,
    })]));
    this.marks = Array.from({ length: MOST }, () => {
      const mark = new Group();
      mark.add(new Mesh(new SphereGeometry(0.034, 16, 12)), new Mesh(shaft), new Mesh(head));
      mark.visible = false;
      group.add(mark);
      return mark;
    });
    this.line = new LineSegments(new BufferGeometry(), new LineBasicMaterial({
      color: COLOURS.line, depthTest: false, transparent: true, opacity: 0.8,
    }));
    this.line.geometry.setAttribute("position", new BufferAttribute(new Float32Array(6), 3));
    this.line.frustumCulled = false;
    this.line.visible = false;
    group.add(this.line);
    this.seen = -Infinity;
    this.showContacts = true;
    this.showLine = true;
  }

  /** Take the touched places and the nearest point of a state. now: [ms]. */
  take({ touched, proximity }, now) {
    const places = touched.filter((each) => !each.unloaded).slice(0, MOST);
    if (places.length) {
      this.seen = now;
      this.marks.forEach((mark, k) => this.put(mark, places[k]));
    }
    this.line.userData.on = Boolean(proximity);
    if (proximity) {
      const { position } = this.line.geometry.attributes;
      position.array.set([...proximity.avatar, ...proximity.cloud]);
      position.needsUpdate = true;
    }
  }

  put(mark, touched) {
    mark.visible = Boolean(touched);
    if (!touched) return;
    mark.position.fromArray(touched.place);
    const [ball, shaft, head] = mark.children;
    const material = this.materials[touched.unknown ? "unknown" : "contact"];
    for (const part of mark.children) part.material = material;
    shaft.visible = head.visible = touched.normal !== null;
    if (touched.normal) {
      mark.quaternion.setFromUnitVectors(new Vector3(0, 1, 0), new Vector3(...touched.normal).normalize());
    }
    ball.visible = true;
  }

  /** Return a text that changes with what is drawn. */
  get signature() {
    const seen = this.marks.map((mark) => (mark.visible ? mark.position.toArray().join() : "")).join(";");
    return `${seen}|${this.line.visible ? this.line.geometry.attributes.position.array.join() : ""}`;
  }

  update(now) {
    const on = this.showContacts && now - this.seen < STAY_MS;
    if (!on) for (const mark of this.marks) mark.visible = false;
    this.line.visible = this.showLine && this.line.userData.on === true;
  }
}
