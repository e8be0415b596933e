// Drawing with WebGL: particles as discs (shaded as balls in 3-D), walls as filled boxes, floor and frame as lines.

import { edges } from "./camera.js";
import { readColour, scaleEnds, scene } from "./scene.js";

const POINTS = `#version 300 es
in vec3 position, previous, reference, material;
in float field;
uniform mat4 view; uniform vec3 low, extent, period; uniform vec4 plain;
uniform vec2 ends; uniform float diameter, top, opacity; uniform int mode;   // see MODES below; 3 is the colour \`plain\`
uniform highp sampler2D scale;
out vec4 colour;
bool absent(vec3 p) { return p.x > 0.999993; }  // ABSENT
vec3 nearest(vec3 d) { return d - period * round(d / mix(vec3(1.0), period, step(1e-20, period))); }
void main() {
  vec3 x = low + extent * position;
  gl_Position = absent(position) ? vec4(2.0, 2.0, 2.0, 1.0) : view * vec4(x, 1.0);  // outside of the clip volume
  gl_PointSize = max(diameter / gl_Position.w, 1.5);
  // Most particles are slow, most errors small: the square root gives them more of the scale.
  float value = mode == 4 ? field
    : absent(mode == 1 ? previous : reference) ? 0.0
    : sqrt(length(nearest(extent * (mode == 1 ? position - previous : position - reference))) / top);
  colour = mode == 0 ? vec4(material, 1.0) : mode == 3 ? plain
    : vec4(texture(scale, vec2(mix(ends.x, ends.y, clamp(value, 0.0, 1.0)), 0.5)).rgb, 1.0);
  colour.a *= opacity;
}`;
const DISC = `#version 300 es
precision highp float;
in vec4 colour; uniform bool ball; out vec4 pixel;
void main() {
  vec2 p = 2.0 * gl_PointCoord - 1.0;
  float r = dot(p, p);
  if (r > 1.0) discard;
  float light = ball ? 0.45 + 0.55 * max(dot(vec3(p.x, -p.y, sqrt(1.0 - r)), normalize(vec3(-0.4, 0.7, 0.8))), 0.0) : 1.0;
  pixel = vec4(colour.rgb * light, colour.a * (ball ? 1.0 : smoothstep(1.0, 1.0 - fwidth(r), r)));
}`;
const LINES = `#version 300 es
in vec3 position; uniform mat4 view; void main() { gl_Position = view * vec4(position, 1.0); }`;
const FLAT = `#version 300 es
precision highp float; uniform vec4 plain; out vec4 pixel; void main() { pixel = plain; }`;
export const MODES = { material: 0, speed: 1, error: 2, plain: 3, field: 4 };
/** Diameter of a disc in spacings, as in panel.py: discs of neighbours overlap, also where a model spreads them unevenly. */
export const DISC_DIAMETER = 2.2;
const FLOOR_TILES = 10;
const ATTRIBUTES = ["position", "previous", "reference", "material", "field"];

export function compile(gl, vertex, fragment, attributes) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  attributes.forEach((name, location) => gl.bindAttribLocation(program, location, name));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const found = {};
  return { program, at: (name) => (found[name] ??= gl.getUniformLocation(program, name)) };
}

/** Binds a new texture, which is interpolated within and constant outside. */
export function bindTexture(gl) {
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
}

/** Draws particles and walls on a canvas. */
export class Drawing {
  /** @param obstacles 16-bit positions, as those of particles. */
  constructor(canvas, obstacles) {
    // Discs are smooth by their shader and walls lie along pixels; in 3-D it would cost software renderers most of a frame.
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) throw new Error("This browser does not offer WebGL 2, which the viewer needs.");
    Object.assign(this, { gl, obstacles });
    addEventListener("pagehide", ({ persisted }) => persisted || gl.getExtension("WEBGL_lose_context")?.loseContext());
    this.points = compile(gl, POINTS, DISC, ATTRIBUTES);
    this.lines = compile(gl, LINES, FLAT, ["position"]);
    this.buffers = ATTRIBUTES.map(() => gl.createBuffer());
    this.corners = gl.createBuffer();
    const rgb = Uint8Array.from(scene.scale.flatMap(readColour), (value) => Math.round(255 * value));
    bindTexture(gl);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, rgb.length / 3, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, rgb);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  /** Takes the colours of the particles, RGB bytes. */
  setColours(rgb) {
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.buffers[ATTRIBUTES.indexOf("material")]);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, rgb, this.gl.STATIC_DRAW);
  }

  /** Clears a panel, (x, y, width, height) in pixels from the canvas's lower left corner, and draws the box. */
  startPanel(panel, view, theme) {
    const gl = this.gl, { domain, bounds } = scene;
    gl.viewport(...panel);
    gl.scissor(...panel);
    gl.enable(gl.SCISSOR_TEST);
    gl.clearColor(...theme.page, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST);
    this.view = view;
    if (scene.dim === 2) {
      this.drawCorners(rectangle(domain), gl.TRIANGLE_STRIP, theme.wall);
      this.drawCorners(rectangle(bounds), gl.TRIANGLE_STRIP, theme.inside);
    } else {
      const ticks = Array.from({ length: FLOOR_TILES + 1 }, (_, tick) => tick / FLOOR_TILES);
      this.drawCorners([[0, 0], [1, 0], [0, 1], [1, 1]].map(onFloor), gl.TRIANGLE_STRIP, theme.inside);
      this.drawCorners(ticks.flatMap((t) => [[t, 0], [t, 1], [0, t], [1, t]].map(onFloor)), gl.LINES, theme.wall);
      this.drawCorners(edges(bounds), gl.LINES, theme.ghost);
    }
  }

  drawCorners(corners, primitive, colour) {
    const gl = this.gl;
    gl.useProgram(this.lines.program);
    gl.uniformMatrix4fv(this.lines.at("view"), false, this.view);
    gl.uniform4f(this.lines.at("plain"), ...colour, 1);
    this.sendCorners(corners);
    gl.drawArrays(primitive, 0, corners.length);
  }

  /** Makes points the positions of what is drawn next. */
  sendCorners(corners) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ARRAY_BUFFER, Float32Array.from(corners.flat()), gl.STREAM_DRAW);
    ATTRIBUTES.forEach((_, location) => gl.disableVertexAttribArray(location));
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
  }

  /**
   * Draws particles at a frame.
   * @param frame {position, previous, reference, field, stride}, 16-bit numbers; of reference and colours, which have more
   *   particles, each stride-th (1 if left out).
   * @param look {mode, top, plain, diameter, opacity, flat}: see the shader; top in domain lengths.
   */
  drawFrame({ position, previous, reference, field, stride = 1 }, view, { mode, top, plain, diameter, opacity = 1, flat }) {
    const gl = this.gl, at = this.points.at, dim = scene.dim;
    if (!position.length) return;
    gl.useProgram(this.points.program);
    const needed = [
      position, mode === MODES.speed && previous, mode === MODES.error && reference, null, mode === MODES.field && field,
    ];
    needed.forEach((values, location) => {
      gl.disableVertexAttribArray(location);
      if (!values) return;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[location]);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STREAM_DRAW);
      gl.enableVertexAttribArray(location);
      const step = values === reference ? 2 * dim * stride : 0;
      gl.vertexAttribPointer(location, values === field ? 1 : dim, gl.UNSIGNED_SHORT, true, step, 0);
    });
    if (mode === MODES.material) {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[3]);
      gl.enableVertexAttribArray(3);
      gl.vertexAttribPointer(3, 3, gl.UNSIGNED_BYTE, true, 3 * stride, 0);
    }
    gl[dim === 3 ? "enable" : "disable"](gl.DEPTH_TEST);
    gl.depthMask(opacity === 1);
    gl.uniformMatrix4fv(at("view"), false, view);
    gl.uniform3f(at("low"), ...inSpace(scene.low));
    gl.uniform3f(at("extent"), ...inSpace(scene.low.map((low, axis) => scene.high[axis] - low)));
    gl.uniform3f(at("period"), ...inSpace(scene.period));
    gl.uniform4f(at("plain"), ...plain);
    gl.uniform1f(at("diameter"), diameter);
    gl.uniform2f(at("ends"), ...scaleEnds());
    gl.uniform1f(at("top"), top);
    gl.uniform1f(at("opacity"), opacity);
    gl.uniform1i(at("mode"), mode);
    gl.uniform1i(at("ball"), dim === 3 && !flat);
    gl.drawArrays(gl.POINTS, 0, position.length / dim);
    gl.depthMask(true);
  }
}

const inSpace = (vector) => [...vector, 0].slice(0, 3);
/** The corners of a rectangle as a strip of triangles. */
export const rectangle = ([[x0, x1], [y0, y1]]) => [[x0, y0, 0], [x1, y0, 0], [x0, y1, 0], [x1, y1, 0]];

/** A point of the box's floor from shares along its two horizontal axes. */
function onFloor(shares) {
  const point = scene.bounds.map(([low]) => low);
  shares.forEach((share, at) => {
    const axis = (scene.up + 1 + at) % 3, [low, high] = scene.bounds[axis];
    point[axis] = low + share * (high - low);
  });
  return point;
}
