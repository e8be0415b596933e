// The pointer over the panels: it turns, moves and zooms the camera, and tells which particle it is at.

import { digits } from "./chart.js";
import { DISC_DIAMETER, inSpace } from "./drawing.js";
import { element, scene } from "./scene.js";

export class Pointer {
  constructor(viewer) {
    Object.assign(this, { viewer, event: null });
    const canvas = element("scene");
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => this.follow(event));
    canvas.addEventListener("pointerleave", () => this.follow(null));
    canvas.addEventListener("wheel", (event) => this.zoom(event));
  }

  /** Turns or moves while a button is down; else shows the particle that the pointer is at. */
  follow(event) {
    this.event = event && !event.buttons ? event : null;
    if (event?.buttons) return this.drag(event);
    if (!this.viewer.playing) this.showParticle();
  }

  showParticle() {
    const note = element("particle"), picked = this.event && this.pick(this.event);
    note.hidden = !picked;
    if (!picked) return;
    const { number, index, x, y } = picked, speed = this.speedOf(this.viewer.trajectories[index], number) / scene.dt;
    note.textContent = `particle ${number}, ${scene.materials[this.viewer.materials[number]].name}, ${digits(speed, 3)} length/s`;
    note.style.transform = `translate(${Math.min(x + 12, element("scene").clientWidth - note.offsetWidth - 4)}px, ${Math.max(y - 30, 0)}px)`;
  }

  /** The particle at a point of the canvas, in 3-D the nearest to the viewer; null where there is none. */
  pick({ offsetX, offsetY }) {
    const panel = this.panelUnder({ offsetX, offsetY }), index = panel.indices.at(-1), { x, y, width, height } = panel;
    const { matrix: m, unit } = this.viewer.camera.view(width, height), positions = this.viewer.trajectories[index];
    let best = null;
    for (let number = 0; number < positions.length / scene.frames / scene.dim; number++) {
      const [a, b, c] = inSpace(this.pointOf(positions, this.viewer.frame, number));
      if (Number.isNaN(a)) continue;
      const [right, up, depth, w] = [0, 1, 2, 3].map((row) => m[row] * a + m[4 + row] * b + m[8 + row] * c + m[12 + row]);
      const at = [x + (width * (1 + right / w)) / 2, y + (height * (1 - up / w)) / 2];
      const away = Math.hypot(at[0] - offsetX, at[1] - offsetY), order = scene.dim === 2 ? away : depth / w;
      if (away < Math.max(6, (DISC_DIAMETER * scene.spacing * unit) / w / 2) && !(best?.order <= order))
        best = { number, index, order, x: at[0], y: at[1] };
    }
    return best;
  }

  /** A particle's position in domain lengths; NaN where it is not there. */
  pointOf(positions, frame, number) {
    const at = (positions.length / scene.frames) * frame + number * scene.dim;
    return scene.low.map((low, axis) => (positions[at] === 65535 ? NaN : low + ((scene.high[axis] - low) * positions[at + axis]) / 65535));
  }

  /** The distance that a particle moves to this frame from the one before. */
  speedOf(positions, number) {
    const [now, before] = [Math.max(this.viewer.frame, Math.min(1, scene.frames - 1)), Math.max(this.viewer.frame - 1, 0)];
    const from = this.pointOf(positions, before, number);
    return Math.hypot(...this.pointOf(positions, now, number).map((value, axis) => {
      const moved = value - from[axis], period = scene.period[axis];
      return period ? moved - period * Math.round(moved / period) : moved;
    }));
  }

  panelUnder(event) {
    return this.viewer.panels().find(({ x, y, width, height }) =>
      event.offsetX >= x && event.offsetX < x + width && event.offsetY >= y && event.offsetY < y + height) ?? this.viewer.panels()[0];
  }

  drag(event) {
    const { width, height } = this.panelUnder(event);
    this.viewer.camera.drag(event.movementX, event.movementY, width, height);
    this.viewer.show();
  }

  zoom(event) {
    event.preventDefault();
    const { x, y, width, height } = this.panelUnder(event);
    const [right, above] = [event.offsetX - x - width / 2, y + height / 2 - event.offsetY];
    this.viewer.camera.zoomBy(Math.exp(-event.deltaY / 500), right, above, width, height);
    this.viewer.show();
  }
}
