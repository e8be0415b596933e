// Drawing with WebGL: particles as discs (shaded as balls in 3-D), walls as filled boxes, floor and frame as lines.

import { readColour, scaleEnds, scene } from "./scene.js";

const POINTS = `#version 300 es
in vec3 position, previous, reference, material;
in float field;
uniform mat4 view; uniform vec3 low, extent, period; uniform vec4 plain;
uniform vec2 ends; uniform float diameter, top, opacity; uniform int mode;   // see MODES below; 3 is the colour \`plain\`
uniform highp sampler2D scale;
out vec4 colour;
bool absent(vec3 p) { return p.x > 0.999993; }  // ABSENT of page.py
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
/** Which positions besides the particles' own a mode reads: 1 of the frame before, 2 of the reference. */
const OTHERS = { [MODES.speed]: 1, [MODES.error]: 2 };

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

/** Draws particles and walls on a canvas. */
export class Drawing {
  /** @param colours RGB bytes of the particles; @param obstacles 16-bit positions, as those of trajectories. */
  constructor(canvas, colours, obstacles) {
    // Discs are smooth by their shader and walls lie along pixels; in 3-D it would cost software renderers most of a frame.
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) throw new Error("This browser does not offer WebGL 2, which the viewer needs.");
    this.gl = gl;
    addEventListener("pagehide", ({ persisted }) => persisted || gl.getExtension("WEBGL_lose_context")?.loseContext());
    this.points = compile(gl, POINTS, DISC, ["position", "previous", "reference", "material", "field"]);
    this.lines = compile(gl, LINES, FLAT, ["position"]);
    this.colours = this.upload(colours);
    this.obstacles = { buffer: this.upload(obstacles), count: obstacles.length / scene.dim };
    this.frames = [gl.createBuffer(), gl.createBuffer(), gl.createBuffer()];
    this.values = gl.createBuffer();
    this.corners = gl.createBuffer();
    this.uploadScale(scene.scale.flatMap((hex) => readColour(hex).map((value) => Math.round(255 * value))));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  upload(values) {
    const buffer = this.gl.createBuffer();
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, buffer);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, values, this.gl.STATIC_DRAW);
    return buffer;
  }

  uploadScale(rgb) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, rgb.length / 3, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, Uint8Array.from(rgb));
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  }

  /** Clears a panel, (x, y, width, height) in pixels from the canvas's lower left corner, and draws the box. */
  startPanel(panel, view, theme) {
    const gl = this.gl;
    this.ends = scaleEnds();
    gl.viewport(...panel);
    gl.scissor(...panel);
    gl.enable(gl.SCISSOR_TEST);
    gl.clearColor(...theme.page, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(this.lines.program);
    gl.uniformMatrix4fv(this.lines.at("view"), false, view);
    for (let i = 0; i < 5; i++) gl.disableVertexAttribArray(i);
    if (scene.dim === 2) {
      this.drawCorners(rectangle(scene.domain), gl.TRIANGLE_STRIP, theme.wall);
      this.drawCorners(rectangle(scene.bounds), gl.TRIANGLE_STRIP, theme.inside);
    } else {
      const floor = floorOf(scene.bounds), ticks = Array.from({ length: FLOOR_TILES + 1 }, (_, tick) => tick / FLOOR_TILES);
      this.drawCorners([floor(0, 0), floor(1, 0), floor(0, 1), floor(1, 1)], gl.TRIANGLE_STRIP, theme.inside);
      this.drawCorners(ticks.flatMap((t) => [floor(t, 0), floor(t, 1), floor(0, t), floor(1, t)]), gl.LINES, theme.wall);
      this.drawCorners(edges(scene.bounds), gl.LINES, theme.ghost);
    }
  }

  drawCorners(corners, primitive, colour) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ARRAY_BUFFER, Float32Array.from(corners.flat()), gl.STREAM_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.uniform4f(this.lines.at("plain"), ...colour, 1);
    gl.drawArrays(primitive, 0, corners.length);
  }

  /**
   * Draws particles at a frame.
   * @param look {mode, top, plain, diameter, field, opacity, stride, flat}: see the shader; top in domain lengths, field of all
   *   frames; the trajectory has each stride-th particle of the reference (1 if left out).
   */
  drawFrame(trajectory, reference, frame, view, look) {
    const gl = this.gl, size = trajectory.length / scene.frames;
    const part = (positions, at) => {
      const length = positions.length / scene.frames;
      return positions.subarray(at * length, (at + 1) * length);
    };
    // Frame 0 has no frame before it: its speeds are those toward frame 1.
    const previous = frame > 0 ? frame - 1 : Math.min(1, scene.frames - 1);
    const needed = [part(trajectory, frame), part(trajectory, previous), part(reference, frame)];
    needed.forEach((values, location) => {
      if (location && location !== OTHERS[look.mode]) return;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.frames[location]);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STREAM_DRAW);
    });
    if (look.mode === MODES.field) {
      const count = size / scene.dim;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.values);
      gl.bufferData(gl.ARRAY_BUFFER, look.field.subarray(frame * count, (frame + 1) * count), gl.STREAM_DRAW);
    }
    this.drawPoints(this.frames, size / scene.dim, view, look);
  }

  drawObstacles(view, look) {
    this.drawPoints(Array(3).fill(this.obstacles.buffer), this.obstacles.count, view, look);
  }

  drawPoints(buffers, count, view, look) {
    const gl = this.gl, at = this.points.at, high = scene.high, dim = scene.dim, { opacity = 1, stride = 1 } = look;
    if (!count) return;
    gl.useProgram(this.points.program);
    buffers.forEach((buffer, location) => {
      if (location && location !== OTHERS[look.mode]) return gl.disableVertexAttribArray(location);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, dim, gl.UNSIGNED_SHORT, true, location === 2 ? 2 * dim * stride : 0, 0);
    });
    if (look.mode === MODES.material) {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.colours);
      gl.enableVertexAttribArray(3);
      gl.vertexAttribPointer(3, 3, gl.UNSIGNED_BYTE, true, 3 * stride, 0);
    } else {
      gl.disableVertexAttribArray(3);
    }
    if (look.mode === MODES.field) {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.values);
      gl.enableVertexAttribArray(4);
      gl.vertexAttribPointer(4, 1, gl.UNSIGNED_SHORT, true, 0, 0);
    } else {
      gl.disableVertexAttribArray(4);
    }
    gl[dim === 3 ? "enable" : "disable"](gl.DEPTH_TEST);
    gl.depthMask(opacity === 1);
    gl.uniformMatrix4fv(at("view"), false, view);
    gl.uniform3f(at("low"), ...inSpace(scene.low));
    gl.uniform3f(at("extent"), ...inSpace(scene.low.map((low, axis) => high[axis] - low)));
    gl.uniform3f(at("period"), ...inSpace(scene.period));
    gl.uniform4f(at("plain"), ...look.plain);
    gl.uniform1f(at("diameter"), look.diameter);
    gl.uniform2f(at("ends"), ...this.ends);
    gl.uniform1f(at("top"), look.top);
    gl.uniform1f(at("opacity"), opacity);
    gl.uniform1i(at("mode"), look.mode);
    gl.uniform1i(at("ball"), dim === 3 && !look.flat);
    gl.drawArrays(gl.POINTS, 0, count);
    gl.depthMask(true);
  }
}

export const inSpace = (vector) => [...vector, 0].slice(0, 3);
export const rectangle = ([[x0, x1], [y0, y1]]) => [[x0, y0, 0], [x1, y0, 0], [x0, y1, 0], [x1, y1, 0]];

/** Points of a box's floor from shares along its two horizontal axes. */
const floorOf = (box) => (...shares) => {
  const point = box.map(([low]) => low);
  shares.forEach((share, at) => {
    const axis = (scene.up + 1 + at) % 3, [low, high] = box[axis];
    point[axis] = low + share * (high - low);
  });
  return point;
};

/** The twelve edges of a box, as pairs of corners. */
export function edges(box) {
  const corners = [];
  for (let axis = 0; axis < 3; axis++)
    for (let side = 0; side < 4; side++)
      for (let end = 0; end < 2; end++) {
        const corner = [0, 0, 0];
        corner[axis] = box[axis][end];
        corner[(axis + 1) % 3] = box[(axis + 1) % 3][side & 1];
        corner[(axis + 2) % 3] = box[(axis + 2) % 3][side >> 1];
        corners.push(corner);
      }
  return corners;
}
