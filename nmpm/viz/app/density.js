// Where an ensemble's members are, in 2-D: the share of them that occupy each cell, as bands; see ensembles.py.

import { bindTexture, compile, rectangle } from "./drawing.js";
import { ABSENT, readColour, scene } from "./scene.js";

const COVER = `#version 300 es
in vec3 position; uniform mat4 view; uniform vec2 low, extent; out vec2 at;
void main() { at = (position.xy - low) / extent; gl_Position = view * vec4(position, 1.0); }`;
const BANDS = `#version 300 es
precision highp float;
in vec2 at; uniform sampler2D share; uniform vec3 levels, tints, colour; uniform vec2 cells; out vec4 pixel;
float smoothShare() {  // cubic B-spline, by four linear look-ups
  vec2 x = at * cells - 0.5, f = fract(x), c = x - f;
  vec2 w0 = (1.0 - f) * (1.0 - f) * (1.0 - f) / 6.0, w1 = 2.0 / 3.0 - f * f * (2.0 - f) / 2.0;
  vec2 w3 = f * f * f / 6.0, w2 = 1.0 - w0 - w1 - w3;
  vec2 left = (c - 0.5 + w1 / (w0 + w1)) / cells, right = (c + 1.5 + w3 / (w2 + w3)) / cells, s = w0 + w1;
  return mix(mix(texture(share, right).r, texture(share, vec2(left.x, right.y)).r, s.x),
    mix(texture(share, vec2(right.x, left.y)).r, texture(share, left).r, s.x), s.y);
}
void main() {
  float value = smoothShare(), edge = max(0.7 * fwidth(value), 1e-4), tint = 0.0;
  for (int i = 0; i < 3; i++) tint = mix(tint, tints[i], smoothstep(levels[i] - edge, levels[i] + edge, value));
  pixel = vec4(colour, tint);
}`;

export class Density {
  /** @param members 16-bit positions: of the first all, of the others each n-th; in all of them each n-th counts. */
  constructor(drawing, members) {
    const { gl } = drawing;
    Object.assign(this, { drawing, members });
    this.bands = compile(gl, COVER, BANDS, ["position"]);
    this.low = scene.bounds.map(([low]) => low);
    this.cells = scene.bounds.map(([low, high]) => Math.ceil((high - low) / scene.bands.cell));
    gl.activeTexture(gl.TEXTURE1);
    bindTexture(gl);
    gl.activeTexture(gl.TEXTURE0);
  }

  /** The share of members that occupy each cell at a frame, rows of cells from the lowest on. */
  share(frame) {
    const [columns, rows] = this.cells, sum = new Float32Array(columns * rows);
    this.members.forEach((positions, index) => {
      const cells = this.occupied(positions, frame, index ? 1 : scene.bands.stride);
      cells.forEach((value, at) => (sum[at] += Math.min(1, value) / this.members.length));
    });
    return sum;
  }

  /** 1 in the cell of each particle, a half in those beside it, a quarter at its corners, added up. */
  occupied(positions, frame, stride) {
    const [columns, rows] = this.cells, cells = new Float32Array(columns * rows), size = positions.length / scene.frames;
    const scale = [0, 1].map((axis) => (scene.high[axis] - scene.low[axis]) / 65535 / scene.bands.cell);
    const shift = [0, 1].map((axis) => (scene.low[axis] - this.low[axis]) / scene.bands.cell);
    for (let i = frame * size; i < (frame + 1) * size; i += 2 * stride) {
      if (positions[i] === ABSENT) continue;
      const x = Math.floor(positions[i] * scale[0] + shift[0]), y = Math.floor(positions[i + 1] * scale[1] + shift[1]);
      if (x < 0 || y < 0 || x >= columns || y >= rows) continue;
      for (let row = Math.max(0, y - 1); row <= Math.min(rows - 1, y + 1); row++)
        for (let column = Math.max(0, x - 1); column <= Math.min(columns - 1, x + 1); column++)
          cells[row * columns + column] += (row === y ? 1 : 0.5) * (column === x ? 1 : 0.5);
    }
    return cells;
  }

  /** Draws the bands over the box, in the panel that `Drawing.startPanel` has begun. */
  draw(frame, view) {
    const gl = this.drawing.gl, at = this.bands.at, [columns, rows] = this.cells, { cell, levels, tints, colour } = scene.bands;
    gl.useProgram(this.bands.program);
    gl.activeTexture(gl.TEXTURE1);
    if (this.frame !== frame) {
      const bytes = Uint8Array.from(this.share(frame), (value) => Math.round(255 * value));
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, columns, rows, 0, gl.RED, gl.UNSIGNED_BYTE, bytes);
      this.frame = frame;
    }
    this.drawing.sendCorners(rectangle(scene.bounds));
    gl.uniformMatrix4fv(at("view"), false, view);
    gl.uniform2f(at("low"), ...this.low);
    gl.uniform2f(at("extent"), columns * cell, rows * cell);
    gl.uniform2f(at("cells"), columns, rows);
    gl.uniform3f(at("levels"), ...levels);
    gl.uniform3f(at("tints"), ...tints);
    gl.uniform3f(at("colour"), ...readColour(colour));
    gl.uniform1i(at("share"), 1);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.activeTexture(gl.TEXTURE0);
  }
}
