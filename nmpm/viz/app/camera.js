// Where panels lie, and how the box is seen in them: one view for all panels.

import { edges } from "./drawing.js";
import { ORBIT, flatView, orbitAxes, orbitView } from "./matrices.js";
import { scene } from "./scene.js";

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

/** The camera: in 2-D it moves and zooms, in 3-D it turns and zooms. */
export class Camera {
  constructor() {
    this.reset();
  }

  reset() {
    this.centre = scene.domain.map(([low, high]) => (low + high) / 2);
    this.zoom = 1;
    this.turn = ORBIT.turn;
    this.tilt = ORBIT.tilt;
  }

  get sizes() {
    return scene.domain.map(([low, high]) => high - low);
  }

  /** Width over height of the box as it is seen. */
  get aspect() {
    if (scene.dim === 2) return this.sizes[0] / this.sizes[1];
    const most = (axis) => Math.max(...this.corners().map((corner) => Math.abs(corner[axis])));
    return most(0) / most(1);
  }

  /** The box's corners from its middle, (right, up, toward the viewer), as they are seen before it is turned. */
  corners() {
    const rows = orbitAxes(scene.up, ORBIT.turn, ORBIT.tilt);
    return edges(this.sizes.map((size) => [-size / 2, size / 2])).map((corner) =>
      rows.map((row) => row.reduce((sum, value, axis) => sum + value * corner[axis], 0)));
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

  /** Pixels to a unit of length, in 2-D. */
  scale(width, height) {
    const margin = 14;
    return this.zoom * Math.min((width - margin) / this.sizes[0], (height - margin) / this.sizes[1]);
  }

  /** The matrix for a panel, and the diameter in pixels of a length of 1 at depth 1. */
  view(width, height) {
    if (scene.dim === 2) {
      const scale = this.scale(width, height);
      return { matrix: flatView(this.centre, scale, width, height), unit: scale };
    }
    const { distance, shift } = this.fit(width, height), size = Math.hypot(...this.sizes);
    const matrix = orbitView(this.centre, scene.up, this.turn, this.tilt, distance / this.zoom, size, width, height);
    for (let column = 0; column < 4; column++) matrix[4 * column + 1] -= shift * matrix[4 * column + 3];
    return { matrix, unit: height / (2 * Math.tan(ORBIT.halfAngle)) };
  }

  /** Follows a drag by (x, y) pixels in a panel. */
  drag(x, y, width, height) {
    if (scene.dim === 2) {
      const scale = this.scale(width, height);
      this.centre = [this.centre[0] - x / scale, this.centre[1] + y / scale];
    } else {
      this.turn -= x / 150;
      this.tilt = Math.min(1.5, Math.max(-1.5, this.tilt + y / 150));
    }
  }

  /** Zooms about a point, in pixels right and above of the panel's middle. */
  zoomBy(factor, x, y, width, height) {
    const before = this.scale(width, height);
    this.zoom = Math.min(100, Math.max(0.3, this.zoom * factor));
    if (scene.dim === 3) return;
    const after = this.scale(width, height);
    this.centre = [this.centre[0] + x / before - x / after, this.centre[1] + y / before - y / after];
  }
}
