// The page on which a visitor's browser runs a model: its session shows bundles frame by frame while a worker computes the
// next one, and takes the commands of a page that is played with. Thrown blocks wait for the next bundle where they are.

import { EMULATOR, Play, RATE } from "./play.js";
import { element, readBytes, scene, unpack } from "./scene.js";

const HURRY = 2, MARGIN = 50; // the next bundle is asked for when what is left is shown within HURRY calls and MARGIN ms
const STATUS = 250; // milliseconds between two reports
const absolute = (path) => new URL(path, location.href).href;

class Session {
  constructor(obstacles) {
    Object.assign(this, { playing: scene.playing, paced: scene.pace, run: 0, picture: 0, called: 0, due: 0, before: 0, reported: 0 });
    this.page = new Play(({ do: name, ...values }) => this[name]?.(values), obstacles);
    this.page.takeMaterials(new Uint8Array(2 * scene.most));
    const start = element("start"), file = location.protocol === "file:";
    start.disabled = file;
    start.textContent = file ? "Browsers run no models from files: open this page by a server (python -m http.server)." : scene.invitation;
    start.onclick = () => this.load();
    this.restart();
    requestAnimationFrame((now) => this.tick(now));
  }

  /** Loads the runtime and the model; the first bundle begins to play when it is there. */
  load() {
    element("start").disabled = true;
    element("start").textContent = "Loading …";
    this.worker = new Worker("worker.js", { type: "module" });
    this.worker.onmessage = ({ data }) => this.take(data);
    this.worker.onerror = () => this.page.say("worker.js cannot be run by this browser.");
    const runtime = { ...scene.runtime, folder: absolute(scene.runtime.folder) };
    this.worker.postMessage({ load: { ...scene, runtime, model: absolute("model.onnx") } });
    this.worker.postMessage({ start: { run: this.run, ...scene.start } });
  }

  take({ ready, error, run, ...bundle }) {
    if (ready) {
      element("start").hidden = this.ready = true;
      this.ask();
    } else if (error) {
      Object.assign(element("start"), { disabled: false, textContent: "Try again" });
      if (run === this.run || !this.ready) this.page.say(error);
    } else if (run === this.run) {
      this.next = bundle;
      this.called = bundle.milliseconds;
    }
  }

  /** Asks for the next bundle, with the blocks that were thrown so far. */
  ask() {
    this.worker.postMessage({ throws: this.waiting.filter((block) => !block.sent) });
    this.waiting.forEach((block) => (block.sent = true));
    this.asked = true;
  }

  tick(now) {
    const passed = Math.min(now - this.before, 100);
    this.before = now;
    this.due = this.playing && this.ready ? this.due + (passed * RATE * this.paced) / 1000 : 0;
    while (this.due >= 1 && this.advance()) this.due -= 1;
    this.due = Math.min(this.due, this.paced);
    if (this.called && now > this.reported + STATUS) this.report(now);
    requestAnimationFrame((time) => this.tick(time));
  }

  report(now) {
    this.reported = now;
    this.page.read({ status: { particles: this.bundle.count, call: this.called, playing: this.playing, beside: false } });
  }

  /** A frame on; false while it is being computed. */
  advance() {
    const left = this.bundle.positions.length / (2 * this.bundle.count) - 1 - this.index;
    if (!this.asked && (1000 * left) / (RATE * this.paced) < HURRY * this.called + MARGIN) this.ask();
    if (left) this.index += 1;
    else if (this.next) {
      Object.assign(this, { bundle: this.next, index: 0, next: null, asked: false });
      this.waiting = this.waiting.filter((block) => !block.sent);
    } else return false;
    this.frame += 1;
    this.show();
    return true;
  }

  /** Shows the particles at this frame, then blocks that wait. */
  show() {
    const { positions, count } = this.bundle, frame = positions.subarray(2 * count * this.index, 2 * count * (this.index + 1));
    const all = [...frame, ...this.waiting.flatMap(({ points }) => points.flat())].slice(0, 4 * scene.most);
    const steps = all.map((value, i) => (65535 * (value - scene.low[i % 2])) / (scene.high[i % 2] - scene.low[i % 2]));
    const shown = Uint16Array.from(steps, (step) => Math.min(65534, Math.max(0, Math.round(step))));
    this.page.takeFrame(EMULATOR, ++this.picture, this.frame, shown);
  }

  // Commands of the page.

  play({ on }) { this.playing = on; }
  pace({ frames }) { this.paced = frames; }

  step() {
    this.playing = false;
    if (this.ready) this.advance();
  }

  restart() {
    const positions = new Float32Array(readBytes(scene.start.position).buffer), bundle = { positions, count: positions.length / 2 };
    Object.assign(this, { run: this.run + 1, bundle, index: 0, frame: 0, next: null, asked: false, waiting: [] });
    this.worker?.postMessage({ start: { run: this.run, ...scene.start } });
    if (this.ready) this.ask();
    this.show();
  }

  /** A block of particles on a lattice about a point, moved into the box. */
  throw({ at, sides, velocity }) {
    if (!this.ready) return;
    const counts = sides.map((side) => Math.max(1, Math.round(side / scene.spacing)));
    const [xs, ys] = at.map((value, axis) => {
      const half = ((counts[axis] - 1) / 2) * scene.spacing, [low, high] = scene.bounds[axis];
      const centre = Math.max(low + half, Math.min(high - half, value));
      return Array.from({ length: counts[axis] }, (_, i) => centre - half + i * scene.spacing);
    });
    const points = xs.flatMap((x) => ys.map((y) => [x, y]));
    const waiting = this.waiting.reduce((sum, block) => sum + block.points.length, 0);
    if (this.bundle.count + waiting + points.length > scene.most)
      return this.page.say(`There are at most ${scene.most.toLocaleString("en")} particles: restart to begin anew.`);
    this.waiting.push({ points, velocity: velocity.map((part) => part * scene.dt) });
    this.show();
  }
}

unpack(scene.obstacles, 1).then((obstacles) => (window.session = new Session(obstacles)));
