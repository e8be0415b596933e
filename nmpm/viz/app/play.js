// A page that is played with: its controls send commands, and a session answers with pictures; see pictures.py.

import { Pointer, bodyCorners } from "./aiming.js";
import { MODES } from "./drawing.js";
import { Page } from "./page.js";
import { coloursOf, element, make, scene } from "./scene.js";

/** Kinds of what a session sends: frames of its two predictors, and the materials of the particles. */
export const EMULATOR = 0;
export const SIMULATOR = 1;
const PACES = [1, 2, 4];
export const RATE = 60; // pictures a second
const TURN = Math.PI / 12;

export class Play extends Page {
  /** @param send Sends a command to the session; @param obstacles 16-bit positions. */
  constructor(send, obstacles) {
    super(obstacles);
    const films = [EMULATOR, SIMULATOR].map(() => ({ position: [], frame: 0, step: 1 }));
    Object.assign(this, { send, films, bodies: [], touched: null, beside: false, times: [], picture: 0, acknowledged: 0 });
    const tools = [["throw", "Throw", "v"], ["pour", "Pour", "p"], ["look", "Look", ""]].filter(([name]) => scene.tools.includes(name));
    this.fillChoices("tools", tools.map(([name, label, key]) => ({ value: name, key, content: [label] })), (name) => (this.tool = name));
    const dot = (colour) => make("i", { style: `background: ${colour}` });
    const materials = scene.materials.map(({ name, colour }, index) => ({ value: index, key: index + 1, content: [dot(colour), name] }));
    this.fillChoices("materials", materials, (index) => (this.material = index));
    element("pace").replaceChildren(...PACES.map((pace) => new Option(`${Number((RATE * pace * scene.dt).toPrecision(2))} × real time`, pace)));
    element("pace").value = scene.pace;
    element("tools").hidden = element("materials").hidden = scene.tools.length < 2;
    element("seed-choice").hidden = element("save").hidden = scene.seed === undefined;
    element("body-tools").hidden = !scene.obstaclesMove;
    element("gravity").hidden = !scene.gravityTurns;
    element("beside").hidden = !scene.simulator;
    this.pointer = new Pointer(this);
    this.showPlaying(scene.playing);
    this.showBeside(scene.beside);
    this.showLegend();
  }

  // What comes in.

  read({ bodies, gravity, seed, say, kind, status }) {
    if (bodies) this.setBodies(bodies);
    if (gravity) this.setGravity(gravity);
    if (seed !== undefined && document.activeElement !== element("seed")) element("seed").value = seed;
    if (say) this.say(say, kind);
    if (status) this.showStatus(status);
  }

  /** Takes the materials of the particles, indices. */
  takeMaterials(materials) { this.drawing.setColours(coloursOf(materials)); }

  /** Takes a picture: 16-bit positions at a frame. */
  takeFrame(kind, picture, frame, position) {
    const before = this.films[kind], same = before.position.length === position.length;
    this.films[kind] = { frame, position, previous: same && before.position, step: Math.max(1, frame - before.frame) };
    if (kind === EMULATOR) this.picture = picture;
    this.show();
  }

  /** Acknowledges what is drawn, and counts it. */
  onDrawn(now) {
    if (this.picture === this.acknowledged) return;
    this.acknowledged = this.picture;
    this.send({ do: "seen", picture: this.picture });
    this.times = [...this.times.filter((time) => time >= now - 1000), now];
  }

  /** Takes the session's bodies, but for one that is being dragged here. */
  setBodies(bodies) {
    const held = this.pointer.action?.body;
    this.bodies = bodies.map((body) => (body.id === held?.id ? held : body));
    if (!bodies.some(({ id }) => id === this.touched)) this.touch(null);
    this.show();
  }

  setGravity(gravity) {
    scene.gravity = gravity;
    element("arrow").style.transform = `rotate(${-Math.atan2(gravity[0], -gravity[1])}rad)`;
  }

  showStatus({ particles, call, simulator, playing, beside }) {
    const ms = (value) => `${value < 10 ? value.toFixed(1) : Math.round(value)} ms`;
    element("pictures").textContent = `${this.times.length} pictures/s`;
    element("call").textContent = `${ms(call)} a call of ${scene.bundle} frames (${ms(call / scene.bundle)} a frame)`
      + (simulator ? `, simulator ${ms(simulator)} a frame` : "");
    element("count").textContent = `${particles.toLocaleString("en")} of at most ${scene.most.toLocaleString("en")} particles`;
    this.showPlaying(playing);
    this.showBeside(beside);
  }

  showBeside(on) {
    element("beside").setAttribute("aria-pressed", on);
    if (on !== this.beside) this.films[SIMULATOR] = { position: [], frame: 0, step: 1 };
    this.beside = on;
    this.show();
  }

  // What is drawn.

  get shown() { return this.beside ? [EMULATOR, SIMULATOR] : [EMULATOR]; }

  labelOf(kind) {
    const { frame } = this.films[kind], behind = this.films[EMULATOR].frame - frame;
    if (kind === EMULATOR) return [scene.model, make("small", {}, `frame ${frame}, ${(frame * scene.dt).toFixed(2)} s`)];
    return [scene.simulator, make("small", {}, frame ? `frame ${frame}${behind > 0 ? `, ${behind} behind` : ""}` : "is starting …")];
  }

  drawBehind() {
    for (const body of this.bodies)
      this.drawing.drawCorners(bodyCorners(body), this.drawing.gl.TRIANGLE_FAN, body.id === this.touched ? this.theme.faint : this.theme.ghost);
  }

  drawContents(kind, matrix, look) {
    const film = this.films[kind], mode = film.previous ? look.mode : MODES.material;
    this.drawing.drawFrame(film, matrix, { ...look, mode, top: scene.fastest * film.step });
  }

  /** The point of the scene under a pixel of the first panel; in 3-D that in the plane through the box's middle. */
  pointAt(x, y) {
    const { x: left, y: top, width, height } = this.panels()[0];
    return this.camera.pointAt((2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height, width, height);
  }

  /** The pixel of a point in the first panel, and further numbers, see `projection`. */
  pixelOf(point) { return this.projection(this.panels()[0])(point); }

  // The controls.

  /** Buttons of which one is chosen. */
  fillChoices(id, options, choose) {
    const buttons = options.map(({ value, key, content }) => {
      const button = make("button", { role: "radio", onclick: () => {
        choose(value);
        buttons.forEach((other) => other.setAttribute("aria-checked", other === button));
      } }, ...content);
      button.dataset.keys = key;
      return button;
    });
    element(id).replaceChildren(...buttons);
    buttons[0].click();
  }

  toggle() {
    this.showPlaying(!this.playing);
    this.send({ do: "play", on: this.playing });
  }

  step() {
    this.showPlaying(false);
    this.send({ do: "step" });
  }

  restart() {
    const seed = Number(element("seed").value);
    this.send({ do: "restart", seed: Number.isInteger(seed) ? seed : -1 });
  }

  nextSeed() {
    element("seed").value = Number(element("seed").value) + 1;
    this.restart();
  }

  setPace() { this.send({ do: "pace", frames: Number(element("pace").value) }); }
  slower() { this.changePace(-1); }
  faster() { this.changePace(1); }

  changePace(by) {
    element("pace").selectedIndex = Math.min(Math.max(element("pace").selectedIndex + by, 0), PACES.length - 1);
    this.setPace();
  }

  save() { this.send({ do: "save" }); }
  toggleBeside() { this.send({ do: "beside", on: !this.beside }); }
  putBody({ currentTarget }) { this.send({ do: "put", kind: currentTarget.id, centre: scene.bounds.map(([low, high]) => (low + high) / 2) }); }
  removeBody() { if (this.touched !== null) this.send({ do: "remove", body: this.touched }); }

  touch(id) {
    this.touched = id;
    element("remove").disabled = id === null;
  }

  legend() { return this.colour === "speed" ? super.legend() : []; }

  /** Turns gravity towards the pointer, from the middle of its button. */
  pullTowards(event) {
    if (!event.buttons) return;
    const button = element("gravity"), { left, top, width, height } = button.getBoundingClientRect();
    button.setPointerCapture(event.pointerId);
    const [x, y] = [event.clientX - left - width / 2, top + height / 2 - event.clientY];
    if (Math.hypot(x, y) > 4) this.pointGravity(Math.atan2(y, x));
  }

  turnByArrow(event) {
    const turn = { ArrowLeft: -TURN, ArrowRight: TURN }[event.key];
    if (!turn) return;
    event.preventDefault();
    event.stopPropagation();
    this.turnGravity(turn);
  }

  turnByKey({ shiftKey }) { if (scene.gravityTurns) this.turnGravity(shiftKey ? -TURN : TURN); }
  turnGravity(turn) { this.pointGravity(Math.atan2(scene.gravity[1], scene.gravity[0]) + turn); }

  pointGravity(angle) {
    const pull = Math.hypot(...scene.gravity), vector = [pull * Math.cos(angle), pull * Math.sin(angle), ...scene.gravity.slice(2)];
    this.setGravity(vector);
    this.pointer.sometimes(() => this.send({ do: "gravity", vector }));
  }
}
