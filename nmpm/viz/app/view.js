// The viewer: playing, choices, keys, and what is drawn.

import { Camera, panelRectangles } from "./camera.js";
import { digits, drawCurve, frameAt } from "./chart.js";
import { DISC_DIAMETER, Drawing, MODES } from "./drawing.js";
import { Ensemble } from "./ensemble.js";
import { colourLegend, gravityNote } from "./legend.js";
import { flatten, multiply } from "./matrices.js";
import { Pointer } from "./picking.js";
import { saveFilm, saveGif, savePicture } from "./saving.js";
import { MOST_PIXELS, THEME_COLOURS, element, inflate, readColour, readField, readTrajectory, scene, undoDifferences } from "./scene.js";

const RATES = [5, 15, 30, 60, 120, 240];

class Viewer {
  /**
   * @param fields For each field of the scene, values of each trajectory or null; @param members further ones;
   * @param materials index of each particle's material.
   */
  constructor(drawing, trajectories, fields, members, materials) {
    Object.assign(this, { drawing, trajectories, fields, materials, frame: 0, playing: false, drawn: 0, camera: new Camera() });
    this.setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    this.fillChoices();
    if (members.length) this.ensemble = new Ensemble(drawing, trajectories.at(-1), members);
    this.listen();
    this.pointer = new Pointer(this);
    new ResizeObserver(() => this.show()).observe(element("scene"));
    const moves = scene.frames > 1, alone = scene.materials.length === 1 && !members.length;
    this.setColour(moves && alone ? "speed" : "material");
    this.seek(0);
    if (moves && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.toggle();
  }

  get frames() { return scene.frames; }
  get colour() { return element("colour").value; }
  get fieldIndex() { return Number(this.colour.replace("field ", "")); }
  get mode() { return this.colour.startsWith("field ") ? MODES.field : MODES[this.colour]; }
  get layout() { return element("layout").value; }
  get rate() { return Number(element("rate").value); }

  fillChoices() {
    const many = scene.trajectories.length > 1;
    const names = ["material", "speed", ...(many ? ["error"] : [])];
    const own = scene.fields.map(({ name }, index) => new Option(name, `field ${index}`));
    element("title").textContent = document.title = scene.title;
    element("colour").replaceChildren(...names.map((name) => new Option(name, name)), ...own);
    element("rate").replaceChildren(...RATES.map((rate) =>
      new Option(`${Number((rate * scene.dt).toPrecision(2))} × real time`, rate, rate === 60, rate === 60)));
    element("layout-choice").hidden = !many;
    element("errors").hidden = !many;
    element("slider").max = scene.frames - 1;
  }

  listen() {
    const on = (id, event, action) => element(id).addEventListener(event, action);
    on("play", "click", () => this.toggle());
    on("slider", "input", () => this.stopAt(Number(element("slider").value)));
    on("colour", "change", () => this.setColour(this.colour));
    on("layout", "change", () => this.show());
    on("members", "change", () => this.setMembers(this.ensemble.mode));
    on("quantity", "change", () => this.show());
    on("reset", "click", () => this.reset());
    on("theme", "click", () => this.turnTheme());
    on("help", "click", () => element("keys").showModal());
    on("curve", "click", (event) => this.stopAt(frameAt(element("curve"), event.offsetX)));
    on("picture", "click", () => savePicture(this));
    on("film", "click", () => saveFilm(this));
    on("gif", "click", () => saveGif(this));
    document.addEventListener("keydown", (event) => this.press(event));
  }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || element("keys").open) return;
    if (event.target.tagName === "SELECT" && event.key !== "Escape") return;
    if (event.target.tagName === "BUTTON" && event.key === " ") return; // it presses the button
    const step = event.shiftKey ? 10 : 1;
    const actions = {
      " ": () => this.toggle(), ArrowRight: () => this.stopAt(this.frame + step), ArrowLeft: () => this.stopAt(this.frame - step),
      Home: () => this.stopAt(0), End: () => this.stopAt(this.frames - 1), "[": () => this.changeRate(-1), "]": () => this.changeRate(1),
      c: () => this.setColour(next(element("colour"))), o: () => this.setLayout(next(element("layout"))),
      m: () => this.ensemble && this.setMembers(next(element("members"))), r: () => this.reset(), t: () => this.turnTheme(), f: () => document.documentElement.requestFullscreen(),
      p: () => savePicture(this), v: () => saveFilm(this), g: () => saveGif(this),
      "?": () => element("keys").showModal(),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  toggle() {
    this.playing = !this.playing;
    element("play").classList.toggle("playing", this.playing);
    element("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
    if (!this.playing) return;
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

  setColour(name) {
    element("colour").value = name;
    this.showLegend();
    this.show();
  }

  setLayout(name) {
    if (scene.trajectories.length < 2) return;
    element("layout").value = name;
    this.show();
  }

  setMembers(mode) {
    element("members").value = mode;
    this.showLegend();
    this.show();
  }

  changeRate(by) {
    const rates = element("rate");
    rates.selectedIndex = Math.min(Math.max(rates.selectedIndex + by, 0), RATES.length - 1);
  }

  reset() {
    this.camera.reset();
    this.show();
  }

  turnTheme() {
    this.setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
    this.showLegend();
    this.show();
  }

  setTheme(name) {
    document.documentElement.dataset.theme = name;
    const style = getComputedStyle(document.documentElement);
    this.theme = Object.fromEntries(
      THEME_COLOURS.map((colour) => [colour, readColour(style.getPropertyValue(`--${colour}`).trim())]));
  }

  /** The panels, in pixels of the page: which trajectories each shows, and where it lies. */
  panels() {
    const canvas = element("scene"), all = this.trajectories.map((_, index) => index);
    const shown = this.layout === "overlay" ? [all] : all.map((index) => [index]);
    const places = panelRectangles(shown.length, canvas.clientWidth, canvas.clientHeight - 26, this.camera.aspect);
    return shown.map((indices, i) => {
      const [x, y, width, height] = places[i];
      return { indices, x, y: y + 26, width, height: height - (places.at(-1)[1] > 0 ? 26 : 0) };
    });
  }

  /** Draws once before the next refresh of the screen, however often it is asked for. */
  show() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  draw() {
    const canvas = element("scene"), ratio = Math.min(devicePixelRatio, MOST_PIXELS);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.round(length * ratio));
    // Setting a size, even the same, would allocate the picture anew.
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const gl = this.drawing.gl;
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(...this.theme.page, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const panels = this.panels();
    panels.forEach((panel) => this.drawPanel(panel, canvas.height, ratio));
    this.placeLabels(panels);
    this.drawChart();
    this.pointer.showParticle();
    this.drawn += 1;
    this.onDrawn?.();
  }

  drawPanel({ indices, x, y, width, height }, canvasHeight, ratio) {
    const pixels = [x, canvasHeight / ratio - y - height, width, height].map((value) => Math.round(value * ratio));
    const { matrix, unit } = this.camera.view(width, height);
    const look = { mode: this.mode, top: this.top(), plain: [0, 0, 0, 1], diameter: DISC_DIAMETER * scene.spacing * unit * ratio };
    const ensemble = indices.includes(this.ensemble?.index) ? this.ensemble : null;
    this.drawing.startPanel(pixels, matrix, this.theme);
    ensemble?.drawBehind(this.frame, matrix);
    this.drawing.drawObstacles(matrix, { ...look, mode: MODES.plain, plain: [...this.theme.ghost, 1] });
    if (scene.dim === 3) this.drawShadow(indices.at(-1), matrix, look);
    for (const index of indices) {
      const chosen = this.fieldLook(index === 0 ? this.referenceLook(look, indices.length > 1) : look, index);
      if (index === ensemble?.index) ensemble.draw(this.trajectories[0], this.frame, matrix, chosen);
      else this.drawing.drawFrame(this.trajectories[index], this.trajectories[0], this.frame, matrix, chosen);
    }
  }

  /** On the floor, straight below the particles. */
  drawShadow(index, matrix, look) {
    if (this.camera.tilt < 0) return;
    const shadow = { ...look, flat: true, mode: MODES.plain, plain: [...this.theme.wall, 1] }, flat = flatten(scene.up, scene.bounds[scene.up][0]);
    this.drawing.drawFrame(this.trajectories[index], this.trajectories[0], this.frame, multiply(matrix, flat), shadow);
    this.drawing.gl.clear(this.drawing.gl.DEPTH_BUFFER_BIT);
  }

  /** With a trajectory's values of the chosen field; one without the field has the colours of its materials. */
  fieldLook(look, index) {
    if (look.mode !== MODES.field) return look;
    const field = this.fields[this.fieldIndex][index];
    return field ? { ...look, field } : { ...look, mode: MODES.material };
  }

  /** How the first trajectory is drawn: grey under another, dark over a density; without error, of which it has none. */
  referenceLook(look, under) {
    if (this.trajectories.length < 2) return look;
    if (under && this.ensemble?.isDensity)
      return { ...look, mode: MODES.plain, plain: [...this.theme.text, 0.8], diameter: 0.6 * look.diameter };
    if (under) return { ...look, mode: MODES.plain, plain: [...this.theme.ghost, 0.7] };
    return look.mode === MODES.error ? { ...look, mode: MODES.material } : look;
  }

  /** What the upper end of the colour scale stands for, in domain lengths. */
  top() {
    return this.colour === "speed" ? scene.fastest : scene.worst;
  }

  placeLabels(panels) {
    element("labels").replaceChildren(...panels.map(({ indices, x, y, width }) => {
      const label = document.createElement("span"), names = indices.map((index) => this.nameOf(index));
      label.textContent = names.length < 2 ? names[0]
        : this.ensemble?.isDensity ? `${names[0]} (dots) over ${names[1]}` : `${names.slice(1).join(", ")} over ${names[0]} (grey)`;
      label.style.left = `${x + width / 2}px`;
      label.style.maxWidth = `${width - 8}px`;
      label.style.top = `${y - 24}px`;
      if (scene.tilt !== null) label.append(gravityNote(scene.tilt));
      return label;
    }));
  }

  nameOf(index) {
    return index === this.ensemble?.index ? this.ensemble.label : scene.trajectories[index].label;
  }

  drawChart() {
    const chart = this.ensemble ? this.ensemble.chart(this.frame, this.theme) : this.errorChart();
    if (!chart.lines.length) return;
    drawCurve(element("curve"), chart, this.frame, this.theme);
    element("now").textContent = chart.now.join("\n");
  }

  errorChart() {
    const [{ label: reference }, ...others] = scene.trajectories;
    const lines = others.map(({ errors }, index) => ({ values: errors, colour: index ? this.theme.faint : this.theme.accent }));
    const now = others.map(({ label, errors }) => `${label}: ${digits(errors[this.frame])} from ${reference}`);
    return { title: "root mean square position error (length), by frame", bands: [], lines, now };
  }

  showLegend() {
    element("legend").replaceChildren(...colourLegend(this), ...(this.ensemble?.legend(this.theme) ?? []));
  }
}

/** The option after the chosen one, in a circle. */
const next = (choice) => choice.options[(choice.selectedIndex + 1) % choice.options.length].value;

async function start() {
  const trajectories = await Promise.all(scene.trajectories.map(readTrajectory));
  const obstacles = undoDifferences(await inflate(scene.obstacles), 1);
  const members = await Promise.all(scene.members.map(readTrajectory));
  const materials = await inflate(scene.particles), colours = scene.materials.map(({ colour }) => readColour(colour).map((value) => 255 * value));
  const drawing = new Drawing(element("scene"), Uint8Array.from([...materials].flatMap((index) => colours[index])), obstacles);
  const fields = await Promise.all(scene.fields.map(({ values }) => Promise.all(values.map(readField))));
  window.viewer = new Viewer(drawing, trajectories, fields, members, materials);
  element("message").hidden = true;
}

start().catch((error) => {
  element("message").textContent = error.message;
});
