// Pictures without a graphics processor: computed here, and shown by a canvas of their own.
//
// WebGL in software needs 1 to 2 us for a point, and 10 to 20 ms to clear a picture and hand it to the
// browser (figures: DESIGN.md). This canvas covers the one of WebGL. What only WebGL can draw, such as
// the spheres of the hierarchy, is drawn there over a rectangle with this picture's colours and depths.

import {
  DataTexture, FloatType, GLSL3, Matrix4, Mesh, NearestFilter, OrthographicCamera, PlaneGeometry,
  RawShaderMaterial, RedFormat, Scene, Vector2,
} from "../vendor/three.module.min.js";
import { Picture, packed } from "./picture.js";
import { Scan } from "./scan.js";
import { figure, lines, screenRows, triangles } from "./shapes.js";
import { shared } from "../points_material.js";

// Names of materials that this draws: of scan points, and of figures.
const SCAN = "scan", FIGURE = "figure";
const MOST_SPREAD = 6;

const RECTANGLE = /* glsl */ `
precision highp float;
uniform sampler2D uColour;
uniform highp sampler2D uDepth;
uniform vec2 uPlanes;
out vec4 colour;
void main() {
  ivec2 size = textureSize(uColour, 0);
  ivec2 at = ivec2(int(gl_FragCoord.x), size.y - 1 - int(gl_FragCoord.y));
  colour = texelFetch(uColour, at, 0);
  float inverse = texelFetch(uDepth, at, 0).r;
  gl_FragDepth = inverse > 0.0 ? uPlanes.y * (1.0 - uPlanes.x * inverse) / (uPlanes.y - uPlanes.x) : 1.0;
}`;

export class Drawing {
  /** over: canvas of WebGL, which this one covers.  ground: colour where nothing is, 0xrrggbb. */
  constructor(over, ground) {
    const canvas = document.createElement("canvas");
    canvas.id = "raster";
    canvas.style.cssText = "position: fixed; inset: 0; width: 100%; height: 100%; pointer-events: none";
    over.after(canvas);
    this.canvas = canvas;
    this.picture = new Picture(canvas, packed((ground >> 16) / 255, ((ground >> 8) & 255) / 255, (ground & 255) / 255));
    this.scan = new Scan();
    this.times = {};
    this.shown = { chosen: 0, given: 0, inside: 0 };
    // Points of the chosen tiles for each one in reach of the picture, at most `MOST_SPREAD`.
    this.spread = 1;
    this.rectangle = null;
  }

  resize(width, height) {
    this.picture.resize(width, height);
  }

  /** Draw. points, lines: scenes.  Returns whether everything is in the picture, and shown. */
  draw({ points, lines: over, camera, shading, renderer }) {
    const { picture } = this;
    const times = [performance.now()];
    points.updateMatrixWorld();
    over.updateMatrixWorld();
    const found = sorted(points), rest = sorted(over);
    const whole = rest.other === 0;
    picture.clear();
    times.push(performance.now());
    const view = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
    this.shown = this.scan.draw(picture, found, camera, view);
    if (this.shown.given) this.spread += 0.3 * (Math.min(MOST_SPREAD, this.shown.chosen / this.shown.given) - this.spread);
    times.push(performance.now());
    for (const each of found.figures) {
      const { uSize, uColour } = each.material.uniforms;
      figure(picture, each.geometry.attributes.position.array, screenRows(picture, view, each.matrixWorld),
        uSize.value * shared.uScale.value, uColour.value.toArray());
    }
    times.push(performance.now());
    if (shading) picture.shade();
    times.push(performance.now());
    for (const each of whole ? [...found.shapes, ...rest.shapes] : found.shapes) this.shape(each, view);
    times.push(performance.now());
    if (whole) picture.show();
    else this.hand(renderer, camera, over);
    times.push(performance.now());
    this.canvas.style.display = whole ? "" : "none";
    ["clear", "points", "figures", "shading", "lines", "show"].forEach((name, k) => { this.times[name] = times[k + 1] - times[k]; });
    this.times.all = times.at(-1) - times[0];
  }

  /** view: from the world to the picture, as a matrix. */
  shape(object, view) {
    const { geometry, material } = object;
    const rows = screenRows(this.picture, view, object.matrixWorld);
    const paint = {
      tint: packed(...material.color.toArray()), share: material.transparent ? Math.round(256 * material.opacity) : 256,
      test: material.depthTest, write: material.depthWrite && material.depthTest, front: material.side === 0,
    };
    const places = geometry.attributes.position.array;
    if (object.isMesh) {
      triangles(this.picture, places, geometry.index?.array, rows, paint);
      return;
    }
    const count = Math.min(geometry.drawRange.count, geometry.attributes.position.count);
    lines(this.picture, places, count, object.isLineSegments ? 2 : 1, rows, paint,
      material.vertexColors ? geometry.attributes.color.array : null);
  }

  /** Draw lines with WebGL over the picture. */
  hand(renderer, camera, over) {
    const { picture } = this;
    this.rectangle ??= new Rectangle();
    this.rectangle.draw(picture, renderer, camera);
    renderer.render(over, camera);
  }
}

class Rectangle {
  constructor() {
    this.material = new RawShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: "in vec3 position; void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }",
      fragmentShader: RECTANGLE,
      uniforms: { uColour: { value: null }, uDepth: { value: null }, uPlanes: { value: new Vector2() } },
    });
    this.scene = new Scene();
    this.scene.add(new Mesh(new PlaneGeometry(2, 2), this.material));
    this.scene.children[0].frustumCulled = false;
    this.camera = new OrthographicCamera();
    this.image = null;
  }

  draw(picture, renderer, camera) {
    const { uColour, uDepth, uPlanes } = this.material.uniforms;
    const { image, depth, width, height } = picture;
    if (this.image !== image) {
      this.image = image;
      uColour.value?.dispose();
      uDepth.value?.dispose();
      uColour.value = new DataTexture(new Uint8Array(image.data.buffer, image.data.byteOffset, image.data.length), width, height);
      uDepth.value = new DataTexture(depth, width, height, RedFormat, FloatType);
      for (const { value } of [uColour, uDepth]) value.minFilter = value.magFilter = NearestFilter;
    }
    uColour.value.needsUpdate = uDepth.value.needsUpdate = true;
    uPlanes.value.set(camera.near, camera.far);
    renderer.setRenderTarget(null);
    renderer.clear();
    renderer.render(this.scene, this.camera);
  }
}

/** Return the visible objects of a scene by what draws them, tiles as their group; `other`: how many this cannot draw. */
function sorted(scene) {
  const found = { tiles: null, scan: [], figures: [], shapes: [], other: 0 };
  const sort = (object) => {
    if (!object.visible) return;
    if (object.isTileGroup) {
      found.tiles = object;
      return;
    }
    const { material } = object;
    if (object.isPoints && material.name === SCAN) found.scan.push(object);
    else if (object.isPoints && material.name === FIGURE) found.figures.push(object);
    else if ((object.isMesh && material.isMeshBasicMaterial && !object.isInstancedMesh) || (object.isLine && material.isLineBasicMaterial)) found.shapes.push(object);
    else if (object.isPoints || object.isMesh || object.isLine) found.other += 1;
    object.children.forEach(sort);
  };
  sort(scene);
  return found;
}
