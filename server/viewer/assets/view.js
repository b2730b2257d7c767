// Canvas, renderer and the picture: points with shading by depth, and lines over them.

import {
  ColorManagement, DepthTexture, GLSL3, LinearSRGBColorSpace, Mesh, NearestFilter, OrthographicCamera, PerspectiveCamera, PlaneGeometry,
  RawShaderMaterial, Scene, UnsignedIntType, Vector2, WebGLRenderTarget, WebGLRenderer,
} from "./vendor/three.module.min.js";
import { shared } from "./points_material.js";
import { Drawing } from "./raster/drawing.js";

const FIELD_OF_VIEW = 62, GROUND = 0x0a0e15;
// Colours are written as they are shown.
ColorManagement.enabled = false;

// Shading by depth (Boucheny 2009): a pixel that lies behind its neighbours is darker, so that edges
// and corners of a cloud without normals are seen.
const SHADING = /* glsl */ `
precision highp float;
uniform sampler2D uColour;
uniform highp sampler2D uDepth;
uniform vec2 uPixel;
uniform vec2 uPlanes;
uniform float uStrength;
out vec4 colour;
float away(float depth) {
  return log2(uPlanes.x * uPlanes.y / (uPlanes.y - depth * (uPlanes.y - uPlanes.x)));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  ivec2 last = ivec2(1.0 / uPixel) - 1;
  float depth = texelFetch(uDepth, at, 0).r;
  vec4 found = texelFetch(uColour, at, 0);
  float shade = 1.0;
  if (depth < 1.0 && uStrength > 0.0) {
    float here = away(depth);
    float sum = 0.0;
    sum += max(0.0, here - away(texelFetch(uDepth, min(at + ivec2(1, 0), last), 0).r));
    sum += max(0.0, here - away(texelFetch(uDepth, max(at - ivec2(1, 0), ivec2(0)), 0).r));
    sum += max(0.0, here - away(texelFetch(uDepth, min(at + ivec2(0, 1), last), 0).r));
    sum += max(0.0, here - away(texelFetch(uDepth, max(at - ivec2(0, 1), ivec2(0)), 0).r));
    shade = exp(-sum * uStrength);
  }
  colour = vec4(found.rgb * shade, 1.0);
  gl_FragDepth = depth;
}`;

export class View {
  /** Make the view on a canvas. Throws where the browser has no WebGL 2.
   *
   * graphics: whether WebGL draws the scan even if it computes in software.
   */
  constructor(canvas, graphics = false) {
    this.canvas = canvas;
    const context = canvas.getContext("webgl2", {
      antialias: false, alpha: false, powerPreference: "high-performance",
    });
    if (!context) throw new Error("WebGL 2 is missing");
    this.renderer = new WebGLRenderer({ canvas, context });
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.renderer.autoClear = false;
    this.renderer.setClearColor(GROUND);
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.05, 2000);
    this.camera.up.set(0, 0, 1);
    this.points = new Scene();
    this.lines = new Scene();
    // Otherwise each picture places all tiles again.
    for (const scene of [this.points, this.lines]) scene.matrixAutoUpdate = false;
    this.shading = true;
    this.software = isSoftware(context);
    // Beyond one pixel of the picture per pixel of the style, shading costs more than it shows.
    this.ratio = this.software ? 1 : Math.min(devicePixelRatio, 1.5);
    // Where WebGL computes in software, our own code is faster: raster/.
    this.drawing = this.software && !graphics ? new Drawing(canvas, GROUND) : null;
    this.target = new WebGLRenderTarget(1, 1, { minFilter: NearestFilter, magFilter: NearestFilter });
    this.target.depthTexture = new DepthTexture(1, 1, UnsignedIntType);
    this.material = new RawShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: "in vec3 position; void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }",
      fragmentShader: SHADING,
      uniforms: {
        uColour: { value: this.target.texture }, uDepth: { value: this.target.depthTexture },
        uPixel: { value: new Vector2() }, uPlanes: { value: new Vector2() }, uStrength: { value: 0 },
      },
    });
    this.screen = new Scene();
    this.screen.add(new Mesh(new PlaneGeometry(2, 2), this.material));
    this.screen.children[0].frustumCulled = false;
    this.screenCamera = new OrthographicCamera();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(this.ratio);
    this.renderer.setSize(width, height, false);
    const size = this.renderer.getDrawingBufferSize(new Vector2());
    if (this.drawing) this.drawing.resize(size.x, size.y);
    else this.target.setSize(size.x, size.y);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.material.uniforms.uPixel.value.set(1 / size.x, 1 / size.y);
    shared.uScale.value = size.y / (2 * Math.tan((FIELD_OF_VIEW * Math.PI) / 360));
  }

  /** Return pixels of a metre at a distance of a metre. */
  get scale() {
    return shared.uScale.value;
  }

  /** Return the canvas with the last picture. */
  get shownCanvas() {
    return this.drawing && this.drawing.canvas.style.display === "" ? this.drawing.canvas : this.canvas;
  }

  draw() {
    const { renderer, camera, material } = this;
    camera.updateMatrixWorld();
    if (this.drawing) {
      this.drawing.draw(this);
      return;
    }
    if (this.shading) {
      renderer.setRenderTarget(this.target);
      renderer.clear();
      renderer.render(this.points, camera);
      renderer.setRenderTarget(null);
      material.uniforms.uPlanes.value.set(camera.near, camera.far);
      material.uniforms.uStrength.value = 7;
      renderer.render(this.screen, this.screenCamera);
    } else {
      renderer.setRenderTarget(null);
      renderer.clear();
      renderer.render(this.points, camera);
    }
    renderer.render(this.lines, camera);
  }
}

function isSoftware(context) {
  const info = context.getExtension("WEBGL_debug_renderer_info");
  const name = info ? String(context.getParameter(info.UNMASKED_RENDERER_WEBGL)) : "";
  return /swiftshader|llvmpipe|software/i.test(name);
}
