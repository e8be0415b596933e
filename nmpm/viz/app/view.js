// The page that plays the trajectories that it contains: time, choices, what is drawn, and the particle under the pointer.

import { flattened } from "./camera.js";
import { drawCurve, frameAt } from "./chart.js";
import { DISC_DIAMETER, MODES } from "./drawing.js";
import { Ensemble } from "./ensemble.js";
import { Page, next } from "./page.js";
import { saveFilm, saveGif, savePicture } from "./saving.js";
import { ABSENT, coloursOf, digits, element, inflate, make, scene, unpack } from "./scene.js";

const RATES = [5, 15, 30, 60, 120, 240];
const PICKED = 6; // pixels around the pointer within which a particle is always found

class Viewer extends Page {
  /**
   * @param trajectories Positions of each; @param fields for each field of the scene, values of each trajectory or null;
   * @param members positions of further members; @param materials index of each particle's material.
   */
  constructor(obstacles, trajectories, fields, members, materials) {
    super(obstacles);
    Object.assign(this, { trajectories, fields, materials, frame: 0, playing: false, pointer: null });
    this.drawing.setColours(coloursOf(materials));
    const alone = trajectories.length === 1, moves = scene.frames > 1;
    element("colour").replaceChildren(
      ...["material", "speed", ...(alone ? [] : ["error"])].map((name) => new Option(name, name)),
      ...scene.fields.map(({ name }, index) => new Option(name, `field ${index}`)));
    element("rate").replaceChildren(...RATES.map((rate) =>
      new Option(`${Number((rate * scene.dt).toPrecision(2))} × real time`, rate, rate === 60, rate === 60)));
    element("layout-choice").hidden = element("errors").hidden = alone;
    element("slider").max = scene.frames - 1;
    if (members.length) this.ensemble = new Ensemble(this.drawing, [trajectories.at(-1), ...members]);
    this.canvas.addEventListener("pointerdown", ({ pointerId }) => this.canvas.setPointerCapture(pointerId));
    this.canvas.addEventListener("pointermove", (event) => this.follow(event));
    this.canvas.addEventListener("pointerleave", () => this.follow(null));
    this.canvas.addEventListener("wheel", (event) => this.zoom(event));
    this.setColour(moves && scene.materials.length === 1 && !members.length ? "speed" : "material");
    this.seek(0);
    if (moves && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.toggle();
  }

  // Time.

  get frames() { return scene.frames; }
  get rate() { return Number(element("rate").value); }

  toggle() {
    this.showPlaying(!this.playing);
    let last = performance.now(), due = 0;
    const tick = (now) => {
      if (!this.playing) return;
      due += ((now - last) / 1000) * this.rate;
      last = now;
      const steps = Math.floor(due);
      due -= steps;
      if (steps) this.seek((this.frame + steps) % this.frames);
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  /** Shows a frame that somebody asked for. */
  stopAt(frame) {
    if (this.playing) this.toggle();
    this.seek(frame);
  }

  seek(frame) {
    this.frame = Math.min(Math.max(frame, 0), this.frames - 1);
    element("slider").value = this.frame;
    const at = this.frame * scene.every;
    element("time").textContent = `frame ${at} of ${(this.frames - 1) * scene.every}, ${(this.frame * scene.dt).toFixed(3)} s`;
    this.show();
  }

  forth({ shiftKey }) { this.stopAt(this.frame + (shiftKey ? 10 : 1)); }
  back({ shiftKey }) { this.stopAt(this.frame - (shiftKey ? 10 : 1)); }
  toFirst() { this.stopAt(0); }
  toLast() { this.stopAt(this.frames - 1); }
  toSlider() { this.stopAt(Number(element("slider").value)); }
  toChart({ offsetX }) { this.stopAt(frameAt(element("curve"), offsetX)); }
  slower() { element("rate").selectedIndex = Math.max(element("rate").selectedIndex - 1, 0); }
  faster() { element("rate").selectedIndex = Math.min(element("rate").selectedIndex + 1, RATES.length - 1); }

  // Choices.

  nextLayout() {
    if (this.trajectories.length > 1) element("layout").value = next(element("layout"));
    this.show();
  }

  nextMembers() {
    if (this.ensemble) element("members").value = next(element("members"));
    this.showLegend();
  }

  legend() { return [...super.legend(), ...(this.ensemble?.legend(this.theme) ?? [])]; }
  fillScreen() { document.documentElement.requestFullscreen(); }
  savePicture() { savePicture(this); }
  saveFilm() { saveFilm(this); }
  saveGif() { saveGif(this); }

  // What is drawn.

  /** Indices of the trajectories in each panel. */
  get shown() {
    const all = this.trajectories.map((_, index) => index);
    return element("layout").value === "overlay" ? [all] : all.map((index) => [index]);
  }

  labelOf(indices) {
    const names = indices.map((index) => (index === this.ensemble?.index ? this.ensemble.label : scene.trajectories[index].label));
    const over = this.ensemble?.isDensity ? `${names[0]} (dots) over ${names[1]}` : `${names.slice(1).join(", ")} over ${names[0]} (grey)`;
    const label = names.length < 2 ? names[0] : over;
    if (scene.tilt === null) return [label];
    return [label, make("small", {}, "gravity ", make("i", { style: `transform: rotate(${-scene.tilt}rad)` }, "↓"))];
  }

  draw() {
    super.draw();
    const chart = this.ensemble ? this.ensemble.chart(this.frame, this.theme) : this.errorChart();
    if (chart.lines.length) drawCurve(element("curve"), chart, this.frame, this.theme);
    element("now").textContent = chart.now.join("\n");
    this.showParticle();
  }

  errorChart() {
    const [{ label: reference }, ...others] = scene.trajectories;
    const lines = others.map(({ errors }, index) => ({ values: errors, colour: index ? this.theme.faint : this.theme.accent }));
    const now = others.map(({ label, errors }) => `${label}: ${digits(errors[this.frame])} from ${reference}`);
    return { title: "root mean square position error (length), by frame", bands: [], lines, now };
  }

  /** The numbers of a trajectory, or of a field, at a frame. */
  part(values, frame) {
    const length = values.length / scene.frames;
    return values.subarray(frame * length, (frame + 1) * length);
  }

  /** What is drawn of a trajectory at the frame that is shown; at frame 0 speeds are those toward frame 1. */
  frameOf(positions, field) {
    const [position, previous, reference] = [
      this.part(positions, this.frame), this.part(positions, this.frame > 0 ? this.frame - 1 : Math.min(1, scene.frames - 1)),
      this.part(this.trajectories[0], this.frame),
    ];
    return { position, previous, reference, field: field && this.part(field, this.frame) };
  }

  drawBehind(indices, matrix) {
    if (this.ensemble?.isDensity && indices.includes(this.ensemble.index)) this.ensemble.density.draw(this.frame, matrix);
  }

  drawContents(indices, matrix, plainLook) {
    const look = { ...plainLook, top: this.colour === "speed" ? scene.fastest : scene.worst };
    if (scene.dim === 3 && this.camera.tilt >= 0) this.drawShadow(this.trajectories[indices.at(-1)], matrix, look);
    for (const index of indices) {
      const field = look.mode === MODES.field && this.fields[Number(this.colour.replace("field ", ""))][index];
      const coloured = look.mode === MODES.field && !field ? { ...look, mode: MODES.material } : look;
      const changed = index === 0 && this.trajectories.length > 1 ? this.referenceLook(coloured, indices.length > 1) : coloured;
      const frameOf = (positions) => this.frameOf(positions, field);
      if (index === this.ensemble?.index) this.ensemble.draw(frameOf, matrix, changed);
      else this.drawing.drawFrame(frameOf(this.trajectories[index]), matrix, changed);
    }
  }

  /** Draws a shadow on the floor, straight below the particles. */
  drawShadow(positions, matrix, look) {
    const gl = this.drawing.gl, flat = flattened(matrix, scene.up, scene.bounds[scene.up][0]);
    this.drawing.drawFrame(this.frameOf(positions), flat, { ...look, flat: true, mode: MODES.plain, plain: [...this.theme.wall, 1] });
    gl.clear(gl.DEPTH_BUFFER_BIT);
  }

  /** How the first trajectory is drawn: grey under another, dark over a density; without error, of which it has none. */
  referenceLook(look, under) {
    if (under && this.ensemble?.isDensity)
      return { ...look, mode: MODES.plain, plain: [...this.theme.text, 0.8], diameter: 0.6 * look.diameter };
    if (under) return { ...look, mode: MODES.plain, plain: [...this.theme.ghost, 0.7] };
    return look.mode === MODES.error ? { ...look, mode: MODES.material } : look;
  }

  // The pointer.

  /** Turns or moves while a button is down; else shows the particle that the pointer is at. */
  follow(event) {
    this.pointer = event && !event.buttons ? event : null;
    if (event?.buttons) return this.drag(event);
    if (!this.playing) this.showParticle();
  }

  showParticle() {
    const note = element("particle"), picked = this.pointer && this.pick(this.pointer);
    note.hidden = !picked;
    if (!picked) return;
    const { number, positions, x, y } = picked, speed = this.stepOf(positions, number) / scene.dt;
    note.textContent = `particle ${number}, ${scene.materials[this.materials[number]].name}, ${digits(speed, 3)} length/s`;
    note.style.transform = `translate(${Math.min(x + 12, this.canvas.clientWidth - note.offsetWidth - 4)}px, ${Math.max(y - 30, 0)}px)`;
  }

  /** The particle at a point of the canvas, in 3-D the nearest to the viewer; null where there is none. */
  pick({ offsetX, offsetY }) {
    const panel = this.panelUnder({ offsetX, offsetY }), positions = this.trajectories[panel.shown.at(-1)];
    const pixelOf = this.projection(panel);
    let best = null;
    for (let number = 0; number < positions.length / scene.frames / scene.dim; number++) {
      const point = this.pointOf(positions, this.frame, number);
      if (Number.isNaN(point[0])) continue;
      const [x, y, depth, unit] = pixelOf(point), away = Math.hypot(x - offsetX, y - offsetY);
      const order = scene.dim === 2 ? away : depth;
      if (away < Math.max(PICKED, (DISC_DIAMETER * scene.spacing * unit) / 2) && !(best?.order <= order))
        best = { number, positions, order, x, y };
    }
    return best;
  }

  /** A particle's position in domain lengths; NaN where it is not there. */
  pointOf(positions, frame, number) {
    const at = (positions.length / scene.frames) * frame + number * scene.dim;
    return scene.low.map((low, axis) => (positions[at] === ABSENT ? NaN : low + ((scene.high[axis] - low) * positions[at + axis]) / 65535));
  }

  /** The distance that a particle moves to this frame from the one before. */
  stepOf(positions, number) {
    const [now, before] = [Math.max(this.frame, Math.min(1, scene.frames - 1)), Math.max(this.frame - 1, 0)];
    const from = this.pointOf(positions, before, number);
    return Math.hypot(...this.pointOf(positions, now, number).map((value, axis) => {
      const moved = value - from[axis], period = scene.period[axis];
      return period ? moved - period * Math.round(moved / period) : moved;
    }));
  }
}

async function start() {
  const unpackAll = (texts) => Promise.all(texts.map((text) => unpack(text, scene.frames)));
  const positionsOf = (each) => unpackAll(each.map(({ positions }) => positions));
  const [obstacles, trajectories, members, materials, fields] = await Promise.all([
    unpack(scene.obstacles, 1), positionsOf(scene.trajectories), positionsOf(scene.members), inflate(scene.particles),
    Promise.all(scene.fields.map(({ values }) => unpackAll(values)))]);
  window.viewer = new Viewer(obstacles, trajectories, fields, members, materials);
}

start().catch((error) => (element("message").textContent = error.message));
