// Shows bundles frame by frame while the worker computes the next one; thrown blocks wait for it where they are.

import { Pointer } from "./aiming.js";
import { MODES } from "./drawing.js";
import { colourLegend } from "./legend.js";
import { element, readColour, scene } from "./scene.js";
import { EMULATOR, Stage } from "./stage.js";

const ICONS = { pause: "M3 2 H6.5 V14 H3 Z M9.5 2 H13 V14 H9.5 Z", play: "M3.5 1.5 L14 8 L3.5 14.5 Z" };
const PACES = [1, 2, 4], RATE = 60; // frames for each picture, and pictures a second
const HURRY = 2, MARGIN = 50; // the next bundle is asked for when what is left is shown within HURRY calls and MARGIN ms
const SAID = 6000; // milliseconds that a line stays

class Player {
  constructor() {
    Object.assign(this, { tool: "throw", material: 0, playing: true, run: 0, call: 0, pictures: [], due: 0, pace: scene.pace });
    scene.pace = 1; // each frame is given to the stage, so that its speeds are those of one frame
    this.stage = new Stage();
    this.stage.onDrawn = (now) => this.count(now);
    this.stage.setColours(Uint8Array.from({ length: 6 * scene.most }, (_, i) => 255 * readColour(scene.materials[0].colour)[i % 3]));
    this.pointer = new Pointer(this.stage, (block) => this.throw(block), this);
    this.fill();
    this.listen();
    this.stage.setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    this.restart();
  }

  touch() {} // the pointer's word for bodies, of which there are none

  /** Loads the runtime and the model; the first bundle begins to play when it is there. */
  load() {
    element("start").disabled = true;
    element("start").textContent = "Loading …";
    this.worker = new Worker("worker.js", { type: "module" });
    this.worker.onmessage = ({ data }) => this.take(data);
    this.worker.onerror = () => this.say("worker.js cannot be run by this browser.");
    const absolute = (path) => new URL(path, location.href).href;
    const runtime = { ...scene.runtime, folder: absolute(scene.runtime.folder) };
    this.worker.postMessage({ load: { ...scene, runtime, model: absolute("model.onnx") } });
    this.worker.postMessage({ start: { run: this.run, ...scene.start } });
  }

  restart() {
    this.run += 1;
    const bytes = Uint8Array.from(atob(scene.start.position), (character) => character.charCodeAt(0));
    const positions = new Float32Array(bytes.buffer);
    Object.assign(this, { bundle: { positions, count: positions.length / 2 }, index: 0, frame: 0, next: null, asked: false, waiting: [] });
    this.worker?.postMessage({ start: { run: this.run, ...scene.start } });
    if (this.ready) this.ask();
    this.show();
  }

  take(message) {
    if (message.ready) {
      element("start").hidden = this.ready = true;
      this.ask();
      requestAnimationFrame((now) => this.tick((this.before = now)));
    } else if (message.error) this.fail(message);
    else if (message.run === this.run) {
      this.next = message;
      this.call = message.milliseconds;
    }
  }

  fail({ error, run }) {
    element("start").disabled = false;
    element("start").textContent = "Try again";
    if (run === this.run || !this.ready) this.say(error);
  }

  /** Asks for the next bundle, with the blocks that were thrown so far. */
  ask() {
    this.worker.postMessage({ throws: this.waiting.filter((block) => !block.sent) });
    this.waiting.forEach((block) => (block.sent = true));
    this.asked = true;
  }

  get left() { return this.bundle.positions.length / (2 * this.bundle.count) - 1 - this.index; }

  tick(now) {
    const passed = Math.min(now - this.before, 100);
    this.before = now;
    this.due = this.playing ? this.due + (passed * RATE * this.pace) / 1000 : 0;
    while (this.due >= 1 && this.advance()) this.due -= 1;
    this.due = Math.min(this.due, this.pace);
    requestAnimationFrame((time) => this.tick(time));
  }

  /** A frame on; false while it is being computed. */
  advance() {
    const soon = (1000 * this.left) / (RATE * this.pace) < HURRY * this.call + MARGIN;
    if (!this.asked && soon) this.ask();
    if (this.left) this.index += 1;
    else if (this.next) this.begin();
    else return false;
    this.frame += 1;
    this.show();
    return true;
  }

  begin() {
    Object.assign(this, { bundle: this.next, index: 0, next: null, asked: false });
    this.waiting = this.waiting.filter((block) => !block.sent);
  }

  /** The particles at the frame that is shown, then blocks that wait, as 16-bit positions. */
  show() {
    const { positions, count } = this.bundle, frame = positions.subarray(2 * count * this.index, 2 * count * (this.index + 1));
    const all = [...frame, ...this.waiting.flatMap(({ points }) => points.flat())].slice(0, 4 * scene.most);
    const steps = all.map((value, i) => (65535 * (value - scene.low[i % 2])) / (scene.high[i % 2] - scene.low[i % 2]));
    this.stage.films[EMULATOR].take(this.frame, Uint16Array.from(steps, (step) => Math.min(65534, Math.max(0, Math.round(step)))));
    this.stage.show();
  }

  /** A block of particles on a lattice about a point, moved into the box. */
  throw({ at, sides, velocity }) {
    if (!this.ready) return;
    const counts = sides.map((side) => Math.max(1, Math.round(side / scene.spacing))), points = [];
    const centre = at.map((value, axis) => {
      const half = ((counts[axis] - 1) / 2) * scene.spacing, [low, high] = scene.bounds[axis];
      return Math.max(low + half, Math.min(high - half, value));
    });
    for (let i = 0; i < counts[0]; i++)
      for (let j = 0; j < counts[1]; j++)
        points.push([i, j].map((step, axis) => centre[axis] + scene.spacing * (step - (counts[axis] - 1) / 2)));
    const waiting = this.waiting.reduce((sum, block) => sum + block.points.length, 0);
    if (this.bundle.count + waiting + points.length > scene.most)
      return this.say(`There are at most ${scene.most.toLocaleString("en")} particles: restart to begin anew.`);
    this.waiting.push({ points, velocity: velocity.map((part) => part * scene.dt) });
    this.show();
  }

  count(now) {
    if (this.ready) this.pictures.push(now);
    while (this.pictures[0] < now - 1000) this.pictures.shift();
    if (!this.call) return;
    const frames = scene.bundle, ms = (value) => `${value.toFixed(1)} ms`;
    element("rate").textContent = `${this.pictures.length} pictures/s`;
    element("call").textContent = `${ms(this.call)} a call of ${frames} frames (${ms(this.call / frames)} a frame)`;
    element("count").textContent = `${this.bundle.count.toLocaleString("en")} particles`;
  }

  say(text) {
    const line = element("say");
    line.textContent = text;
    line.hidden = false;
    clearTimeout(this.saying);
    this.saying = setTimeout(() => (line.hidden = true), SAID);
  }

  fill() {
    element("title").textContent = scene.title;
    element("pace").replaceChildren(...PACES.map((pace) => new Option(`${Number((RATE * pace * scene.dt).toPrecision(2))} × real time`, pace)));
    element("pace").value = this.pace;
    this.setPlaying(true);
    const file = location.protocol === "file:";
    element("start").disabled = file;
    element("start").textContent = file ? "Browsers run no models from files: open this page by a server (python -m http.server)." : scene.invitation;
  }

  listen() {
    const on = (id, name, action) => element(id).addEventListener(name, action);
    on("start", "click", () => this.load());
    on("play", "click", () => this.setPlaying(!this.playing));
    on("step", "click", () => this.step());
    on("restart", "click", () => this.restart());
    on("pace", "change", () => (this.pace = Number(element("pace").value)));
    on("theme", "click", () => this.stage.setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));
    on("colour", "change", () => this.showLegend());
    document.addEventListener("keydown", (event) => this.press(event));
  }

  press(event) {
    const actions = { " ": () => this.setPlaying(!this.playing), ArrowRight: () => this.step(), r: () => this.restart() };
    if (event.ctrlKey || event.metaKey || event.altKey || !actions[event.key]) return;
    if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName) && event.key !== "r") return;
    event.preventDefault();
    actions[event.key]();
  }

  setPlaying(on) {
    this.playing = on;
    element("play").innerHTML = `<svg viewBox="0 0 16 16"><path d="${on ? ICONS.pause : ICONS.play}"/></svg>`;
    element("play").setAttribute("aria-label", on ? "Pause" : "Play");
  }

  step() {
    this.setPlaying(false);
    if (this.ready) this.advance();
  }

  showLegend() {
    const colour = element("colour").value;
    element("legend").replaceChildren(...(colour === "speed" ? colourLegend({ colour, mode: MODES.speed }) : []));
    this.stage.show();
  }
}

window.player = new Player();
