// What is drawn: the emulator's panel, the simulator's beside it, the bodies, and the frames that come in.

import { drawBody } from "./bodies.js";
import { Camera, panelRectangles } from "./camera.js";
import { DISC_DIAMETER, Drawing, MODES, inSpace } from "./drawing.js";
import { MOST_PIXELS, THEME_COLOURS, element, readColour, scene } from "./scene.js";

const HEAD = 26; // pixels above each panel, for its label
export const EMULATOR = 0;
export const SIMULATOR = 1;
export const COLOURS = 2;

/** The inverse of a 4 × 4 matrix stored by columns. */
function inverse(matrix) {
  const rows = [0, 1, 2, 3].map((r) => [0, 1, 2, 3].map((c) => matrix[4 * c + r]).concat([0, 1, 2, 3].map((c) => Number(c === r))));
  for (let at = 0; at < 4; at++) {
    const pivot = rows.slice(at).reduce((best, _, i) => (Math.abs(rows[at + i][at]) > Math.abs(rows[best][at]) ? at + i : best), at);
    [rows[at], rows[pivot]] = [rows[pivot], rows[at]];
    rows[at] = rows[at].map((value) => value / rows[at][at]);
    for (let r = 0; r < 4; r++) if (r !== at) rows[r] = rows[r].map((value, c) => value - rows[r][at] * rows[at][c]);
  }
  return Float64Array.from({ length: 16 }, (_, i) => rows[i % 4][4 + Math.floor(i / 4)]);
}

const transform = (matrix, point) => [0, 1, 2, 3].map((r) => point.reduce((sum, value, c) => sum + matrix[4 * c + r] * value, 0));

/** Frames of one predictor, as they come in: the last one, and the one before for speeds. */
class Film {
  constructor(gl) {
    this.gl = gl;
    this.buffers = [gl.createBuffer(), gl.createBuffer()];
    this.count = this.before = this.frame = 0;
  }

  take(frame, positions) {
    this.buffers.reverse();
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.buffers[0]);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, positions, this.gl.DYNAMIC_DRAW);
    this.before = this.count;
    [this.count, this.frame] = [positions.length / scene.dim, frame];
  }
}

export class Stage {
  constructor() {
    const canvas = element("scene");
    this.canvas = canvas;
    this.camera = new Camera();
    this.drawing = new Drawing(canvas, new Uint8Array(0), Uint16Array.from(scene.obstacles));
    this.films = [new Film(this.drawing.gl), new Film(this.drawing.gl)];
    this.bodies = [];
    this.beside = false;
    this.drawn = 0;
    new ResizeObserver(() => this.show()).observe(canvas);
  }

  setColours(rgb) {
    this.drawing.gl.deleteBuffer(this.drawing.colours);
    this.drawing.colours = this.drawing.upload(rgb);
  }

  setTheme(name) {
    document.documentElement.dataset.theme = name;
    const style = getComputedStyle(document.documentElement);
    this.theme = Object.fromEntries(
      THEME_COLOURS.map((colour) => [colour, readColour(style.getPropertyValue(`--${colour}`).trim())]));
    this.show();
  }

  /** The panels in pixels of the page, from the canvas's upper left corner. */
  panels() {
    const { clientWidth: width, clientHeight: height } = this.canvas, count = this.beside ? 2 : 1;
    return panelRectangles(count, width, height - HEAD * count, this.camera.aspect).map(([x, y, w, h], i) =>
      ({ x, y: y + HEAD * (y > 0 ? i + 1 : 1), width: w, height: h }));
  }

  /** The point of the scene under a pixel of the first panel; in 3-D that in the plane through the box's middle. */
  pointAt(x, y) {
    const { x: left, y: top, width, height } = this.panels()[0], { matrix } = this.camera.view(width, height);
    const across = [(2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height];
    if (scene.dim === 2) return across.map((value, axis) => (value - matrix[12 + axis]) / matrix[5 * axis]);
    const middle = transform(matrix, [...inSpace(scene.domain.map(([low, high]) => (low + high) / 2)), 1]);
    const point = transform(inverse(matrix), [across[0] * middle[3], across[1] * middle[3], middle[2], middle[3]]);
    return point.slice(0, scene.dim).map((value) => value / point[3]);
  }

  /** The pixel of a point in the first panel. */
  pixelOf(point) {
    const { x, y, width, height } = this.panels()[0], { matrix } = this.camera.view(width, height);
    const [a, b, , w] = transform(matrix, [...inSpace(point), 1]);
    return [x + (width * (1 + a / w)) / 2, y + (height * (1 - b / w)) / 2];
  }

  /** Draws once before the next refresh of the screen, however often it is asked for. */
  show() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame((now) => {
      this.waiting = false;
      this.draw();
      this.onDrawn?.(now);
    });
  }

  draw() {
    const ratio = Math.min(devicePixelRatio, MOST_PIXELS), { canvas } = this, gl = this.drawing.gl;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.round(length * ratio));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(...this.theme.page, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.panels().forEach((panel, index) => this.drawPanel(panel, this.films[index], ratio));
    this.drawn += 1;
  }

  drawPanel({ x, y, width, height }, film, ratio) {
    const pixels = [x, this.canvas.height / ratio - y - height, width, height].map((value) => Math.round(value * ratio));
    const { matrix, unit } = this.camera.view(width, height), speed = element("colour").value === "speed";
    const mode = speed && film.before === film.count ? MODES.speed : MODES.material;
    const look = { mode, top: scene.fastest * scene.pace, plain: [...this.theme.ghost, 1], diameter: DISC_DIAMETER * scene.spacing * unit * ratio };
    this.drawing.startPanel(pixels, matrix, this.theme);
    for (const body of this.bodies) drawBody(this.drawing, body, body.id === this.touched ? this.theme.faint : this.theme.ghost);
    this.drawing.drawObstacles(matrix, { ...look, mode: MODES.plain });
    this.drawing.drawPoints(film.buffers, film.count, matrix, look);
  }
}
