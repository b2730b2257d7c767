// The avatar at a clash as a ghost, with its contact points and contact normals.

import {
  ConeGeometry, CylinderGeometry, Group, InstancedMesh, Matrix4, Mesh, MeshBasicMaterial, SphereGeometry, Vector3,
} from "../vendor/three.module.min.js";
import { figure, figureMaterial } from "../figure.js";

const MOST_PLACES = 64, MOST_ARROWS = 8, LENGTH = 0.3;
const COLOURS = { body: 0xdfe6f2, contact: 0xff5448, arrow: 0xffc2bc };

export class Ghost {
  /** group: object for what is drawn over the scan. */
  constructor(group) {
    this.group = group;
    this.body = [];
    const look = { radius: 0.025, colour: COLOURS.body, light: [0.5, 0.55, 0], opacity: 0.62, transparent: true };
    // First the depths alone: of a translucent body, only its near side is seen.
    this.bodyMaterials = [false, true].map((colorWrite) => figureMaterial({ ...look, colorWrite, depthWrite: !colorWrite }));
    const over = { depthTest: false, transparent: true };
    this.places = new InstancedMesh(
      new SphereGeometry(0.016, 10, 8), new MeshBasicMaterial({ ...over, color: COLOURS.contact, opacity: 0.9 }), MOST_PLACES);
    this.places.frustumCulled = false;
    this.places.renderOrder = 3;
    const material = new MeshBasicMaterial({ ...over, color: COLOURS.arrow, opacity: 0.95 });
    const shaft = new CylinderGeometry(0.007, 0.007, LENGTH, 8).translate(0, LENGTH / 2, 0);
    const head = new ConeGeometry(0.024, 0.07, 12).translate(0, LENGTH + 0.03, 0);
    this.arrows = Array.from({ length: MOST_ARROWS }, () => {
      const arrow = new Group();
      arrow.add(new Mesh(shaft, material), new Mesh(head, material));
      for (const part of arrow.children) part.renderOrder = 4;
      group.add(arrow);
      return arrow;
    });
    group.add(this.places);
    this.version = 0;
    this.hide();
  }

  /** Show the avatar at a pose, rows of a matrix. geometry: its points.  radius: of a point [m]. */
  show({ pose, places, clusters }, geometry, radius) {
    this.hide();
    if (geometry) {
      this.body = this.bodyMaterials.map((material, k) => {
        material.uniforms.uSize.value = 2 * radius;
        const body = figure(geometry, material);
        body.matrixAutoUpdate = false;
        body.matrix.set(...pose.flat());
        body.renderOrder = -2 + k;
        this.group.add(body);
        return body;
      });
    }
    const shown = places.slice(0, MOST_PLACES);
    shown.forEach((place, k) => this.places.setMatrixAt(k, new Matrix4().makeTranslation(...place)));
    this.places.count = shown.length;
    this.places.instanceMatrix.needsUpdate = true;
    this.places.visible = shown.length > 0;
    clusters.slice(0, MOST_ARROWS).forEach(({ place, normal }, k) => {
      const way = new Vector3(...normal);
      if (way.lengthSq() < 0.5) return;
      this.arrows[k].visible = true;
      this.arrows[k].position.fromArray(place);
      this.arrows[k].quaternion.setFromUnitVectors(new Vector3(0, 1, 0), way.normalize());
    });
    this.version += 1;
  }

  hide() {
    this.group.remove(...this.body);
    this.body = [];
    this.places.visible = false;
    for (const arrow of this.arrows) arrow.visible = false;
    this.version += 1;
  }

  /** Return how many contact points and contact normals are shown. */
  get counts() {
    return {
      body: this.body.length > 0,
      places: this.places.visible ? this.places.count : 0,
      normals: this.arrows.filter((arrow) => arrow.visible).length,
    };
  }
}
