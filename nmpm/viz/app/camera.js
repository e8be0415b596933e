// How the box is seen: one view for all panels, and where these lie. Matrices are stored by columns, as WebGL wants them.

import { scene } from "./scene.js";

// In 3-D: the first view, half of the camera's vertical angle, and the share of a panel that the box fills.
const ORBIT = { turn: 0.5, tilt: 0.35, halfAngle: 0.35, filled: 0.96 };
const MARGIN = 14; // pixels around the box, in 2-D

const dot = (first, second) => first.reduce((sum, value, axis) => sum + value * second[axis], 0);

/** A point in clip space: right, up, depth and the divisor of these. */
export const project = (matrix, [x, y, z = 0]) =>
  [0, 1, 2, 3].map((row) => matrix[row] * x + matrix[4 + row] * y + matrix[8 + row] * z + matrix[12 + row]);

/** The matrix that first moves points along an axis to a plane across it. */
export function flattened(matrix, axis, at) {
  return matrix.map((value, i) => (i >= 12 ? value + at * matrix[4 * axis + i - 12] : i >> 2 === axis ? 0 : value));
}

/** Rectangles (x, y, width, height) of `count` panels, in pixels from the canvas's upper left corner. */
export function panelRectangles(count, width, height, aspect) {
  let best = null;
  for (let columns = 1; columns <= count; columns++) {
    const rows = Math.ceil(count / columns), w = width / columns, h = height / rows;
    const size = Math.min(w, h * aspect); // width of the box in a panel
    if (!best || size > best.size) best = { size, columns, w, h };
  }
  return Array.from({ length: count }, (_, i) =>
    [(i % best.columns) * best.w, Math.floor(i / best.columns) * best.h, best.w, best.h].map(Math.round));
}

/** The twelve edges of a box, as pairs of corners. */
export function edges(box) {
  const starts = [0, 1, 2].flatMap((axis) => [0, 1, 2, 3].map((side) => [axis, side]));
  return starts.flatMap(([axis, side]) => [0, 1].map((end) => {
    const corner = [0, 0, 0];
    [end, side & 1, side >> 1].forEach((which, at) => (corner[(axis + at) % 3] = box[(axis + at) % 3][which]));
    return corner;
  }));
}

/** Right, up and toward the viewer, of a viewer turned about the vertical axis and tilted above it. */
function orbitAxes(turn, tilt) {
  const [c, s, d, e] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
  // In coordinates (a, b, up) with the horizontal axes a and b, right-handed.
  return [[c, s, 0], [-s * e, c * e, d], [s * d, -c * d, e]].map((row) => [0, 1, 2].map((axis) => row[(axis - scene.up + 2) % 3]));
}

/** The camera: in 2-D it moves and zooms, in 3-D it turns and zooms. */
export class Camera {
  constructor() {
    this.sizes = scene.domain.map(([low, high]) => high - low);
    this.reset();
  }

  reset() {
    this.centre = scene.domain.map(([low, high]) => (low + high) / 2);
    Object.assign(this, { zoom: 1, turn: ORBIT.turn, tilt: ORBIT.tilt });
  }

  /** Width over height of the box as it is seen. */
  get aspect() {
    if (scene.dim === 2) return this.sizes[0] / this.sizes[1];
    const most = (axis) => Math.max(...this.corners().map((corner) => Math.abs(corner[axis])));
    return most(0) / most(1);
  }

  /** The box's corners from its middle, (right, up, toward the viewer), as they are seen before it is turned. */
  corners() {
    const axes = orbitAxes(ORBIT.turn, ORBIT.tilt);
    return edges(this.sizes.map((size) => [-size / 2, size / 2])).map((corner) => axes.map((axis) => dot(axis, corner)));
  }

  /** The least distance from which the whole box is seen, and how far its middle then is above the panel's. */
  fit(width, height) {
    const corners = this.corners(), size = Math.hypot(...this.sizes), slope = Math.tan(ORBIT.halfAngle);
    let [near, far, shift] = [size / 2, 100 * size, 0];
    for (let i = 0; i < 30; i++) {
      const distance = (near + far) / 2;
      const ends = (axis, side) => corners.map((corner) => corner[axis] / (distance - corner[2]) / slope / side);
      const [across, along] = [ends(0, width / height), ends(1, 1)], [low, high] = [Math.min(...along), Math.max(...along)];
      const fits = Math.max(...across.map(Math.abs), (high - low) / 2) < ORBIT.filled;
      if (fits) [far, shift] = [distance, (low + high) / 2];
      else near = distance;
    }
    return { distance: far, shift };
  }

  /**
   * How a panel shows the scene: the matrix to clip space, `unit`, the pixels of a length of 1 at depth 1, and `depth`, that of
   * the box's middle; `axes` lead right and up by `reach`, half of the panel, from the point that is `shift` halves below it.
   */
  view(width, height) {
    if (scene.dim === 2) {
      const unit = this.zoom * Math.min((width - MARGIN) / this.sizes[0], (height - MARGIN) / this.sizes[1]);
      const [x, y] = [(2 * unit) / width, (2 * unit) / height], [a, b] = this.centre;
      const matrix = new Float32Array([x, 0, 0, 0, 0, y, 0, 0, 0, 0, 0, 0, -x * a, -y * b, 0, 1]);
      return { matrix, unit, depth: 1, axes: [[1, 0], [0, 1]], reach: [1 / x, 1 / y], shift: 0 };
    }
    const { distance, shift } = this.fit(width, height), size = Math.hypot(...this.sizes), depth = distance / this.zoom;
    const axes = orbitAxes(this.turn, this.tilt), slope = Math.tan(ORBIT.halfAngle), near = depth / 50, far = depth + 4 * size;
    const [right, up, toward] = axes.map((axis) => [...axis, -dot(axis, this.centre)]), away = toward.map((value) => -value);
    away[3] += depth;
    const rows = [
      right.map((value) => (value * height) / width / slope), up.map((value, i) => value / slope - shift * away[i]),
      away.map((value, i) => (value * (far + near) - Number(i === 3) * 2 * far * near) / (far - near)), away,
    ];
    const matrix = Float32Array.from({ length: 16 }, (_, i) => rows[i % 4][i >> 2]);
    return { matrix, unit: height / (2 * slope), depth, axes, reach: [(depth * slope * width) / height, depth * slope], shift };
  }

  /** The point of the plane through the box's middle at shares (-1 … 1) of a panel, to the right and up. */
  pointAt(right, up, width, height) {
    const { axes, reach, shift } = this.view(width, height), steps = [right * reach[0], (up + shift) * reach[1]];
    return this.centre.map((value, axis) => value + steps[0] * axes[0][axis] + steps[1] * axes[1][axis]);
  }

  /** Follows a drag by (x, y) pixels in a panel. */
  drag(x, y, width, height) {
    if (scene.dim === 2) {
      const { unit } = this.view(width, height);
      this.centre = [this.centre[0] - x / unit, this.centre[1] + y / unit];
    } else {
      this.turn -= x / 150;
      this.tilt = Math.min(1.5, Math.max(-1.5, this.tilt + y / 150));
    }
  }

  /** Zooms about a point, in pixels right and above of the panel's middle. */
  zoomBy(factor, x, y, width, height) {
    const before = this.view(width, height).unit;
    this.zoom = Math.min(100, Math.max(0.3, this.zoom * factor));
    if (scene.dim === 3) return;
    const after = this.view(width, height).unit;
    this.centre = [this.centre[0] + x / before - x / after, this.centre[1] + y / before - y / after];
  }
}
