// Playing: the connection to the server, the controls, and the figures.

import { Pointer } from "./aiming.js";
import { MODES } from "./drawing.js";
import { colourLegend } from "./legend.js";
import { element, scene } from "./scene.js";
import { COLOURS, EMULATOR, SIMULATOR, Stage } from "./stage.js";

const ICONS = { pause: "M3 2 H6.5 V14 H3 Z M9.5 2 H13 V14 H9.5 Z", play: "M3.5 1.5 L14 8 L3.5 14.5 Z" };
const PACES = [1, 2, 4];
const TURN = Math.PI / 12;
const SAID = 6000; // milliseconds that a line stays

class Play {
  constructor() {
    Object.assign(this, { tool: "throw", material: 0, pictures: [], picture: 0, acknowledged: 0, playing: true });
    const socket = new WebSocket(`${location.origin.replace("http", "ws")}${location.pathname}socket`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => (typeof data === "string" ? this.read(JSON.parse(data)) : this.take(data));
    socket.onclose = ({ reason }) => this.end(reason);
    this.socket = socket;
    this.send = (command) => socket.readyState === WebSocket.OPEN && socket.send(JSON.stringify(command));
  }

  // What comes in.

  read(message) {
    if (message.scene) this.begin(message.scene);
    if (message.bodies) this.setBodies(message.bodies);
    if (message.gravity) this.setGravity(message.gravity, message.seed);
    if (message.say) this.say(message.say, message.kind);
    if (message.status) this.showStatus(message.status);
  }

  take(data) {
    const [kind, number, frame] = new Uint32Array(data, 0, 4);
    if (kind === COLOURS) return this.stage.setColours(new Uint8Array(data, 16));
    this.stage.films[kind].take(frame, new Uint16Array(data, 16));
    if (kind === EMULATOR) this.picture = number;
    this.stage.show();
  }

  begin(described) {
    Object.assign(scene, described);
    this.stage = new Stage();
    this.stage.onDrawn = (now) => this.drawnAt(now);
    this.pointer = new Pointer(this.stage, this.send, this);
    this.fill();
    this.listen();
    this.stage.setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    this.showLegend();
    element("message").hidden = true;
  }

  end(reason) {
    element("message").textContent = `${reason || "nmpm play has ended"}. Reload the page to play on.`;
    element("message").hidden = false;
  }

  /** Acknowledges what is drawn, and counts it. */
  drawnAt(now) {
    if (this.picture === this.acknowledged) return;
    this.acknowledged = this.picture;
    this.send({ do: "seen", picture: this.picture });
    this.pictures.push(now);
    while (this.pictures[0] < now - 1000) this.pictures.shift();
    this.placeLabels();
  }

  /** The server's bodies, but for one that is being dragged here. */
  setBodies(bodies) {
    const held = this.pointer.action?.body;
    this.stage.bodies = bodies.map((body) => (body.id === held?.id ? held : body));
    if (!bodies.some(({ id }) => id === this.stage.touched)) this.touch(null);
    this.stage.show();
  }

  setGravity(gravity, seed) {
    scene.gravity = gravity;
    if (seed !== undefined && document.activeElement !== element("seed")) element("seed").value = seed;
    element("arrow").style.transform = `rotate(${-Math.atan2(gravity[0], -gravity[1])}rad)`;
  }

  showStatus({ particles, call, simulator, playing, beside }) {
    const ms = (value) => `${value < 10 ? value.toFixed(1) : Math.round(value)} ms`;
    element("rate").textContent = `${this.pictures.length} pictures/s`;
    element("call").textContent = `${ms(call)} a call of ${scene.bundle} frames (${ms(call / scene.bundle)} a frame)`
      + (simulator ? `, simulator ${ms(simulator)} a frame` : "");
    element("count").textContent = `${particles.toLocaleString("en")} of at most ${scene.most.toLocaleString("en")} particles`;
    this.showPlaying(playing);
    this.showBeside(beside);
  }

  showPlaying(on) {
    this.playing = on;
    element("play").innerHTML = `<svg viewBox="0 0 16 16"><path d="${on ? ICONS.pause : ICONS.play}"/></svg>`;
    element("play").setAttribute("aria-label", on ? "Pause" : "Play");
  }

  showBeside(on) {
    element("beside").setAttribute("aria-pressed", on);
    if (on === this.stage.beside) return;
    this.stage.beside = on;
    Object.assign(this.stage.films[SIMULATOR], { count: 0, frame: 0 });
    this.stage.show();
  }

  say(text, kind) {
    const line = element("say");
    line.textContent = text;
    line.className = kind;
    line.hidden = false;
    clearTimeout(this.saying);
    this.saying = setTimeout(() => (line.hidden = true), SAID);
  }

  placeLabels() {
    const [now, simulated] = this.stage.films.map(({ frame }) => frame), behind = now - simulated;
    const texts = [
      [scene.model, `frame ${now}, ${(now * scene.dt).toFixed(2)} s`],
      [scene.simulator, simulated ? `frame ${simulated}${behind > 0 ? `, ${behind} behind` : ""}` : "is starting …"],
    ];
    element("labels").replaceChildren(...this.stage.panels().map(({ x, y, width }, index) => {
      const label = document.createElement("span"), time = document.createElement("small");
      [label.textContent, time.textContent] = texts[index];
      Object.assign(label.style, { left: `${x + width / 2}px`, top: `${y - 24}px` });
      label.append(time);
      return label;
    }));
  }

  // The controls.

  fill() {
    element("title").textContent = document.title = `nmpm play · ${scene.title}`;
    const tools = [["throw", "Throw"], ["pour", "Pour"], ...(scene.dim === 3 ? [["look", "Look"]] : [])];
    this.choices("tools", tools, (name) => (this.tool = name));
    this.choices("materials", scene.materials.map(({ name, colour }, index) => [index, name, colour]), (index) => (this.material = index));
    element("pace").replaceChildren(...PACES.map((pace) => new Option(`${Number((60 * pace * scene.dt).toPrecision(2))} × real time`, pace)));
    element("pace").value = scene.pace;
    element("body-tools").hidden = !scene.obstaclesMove;
    element("gravity").hidden = !scene.gravityTurns;
    element("beside").hidden = !scene.simulator;
    element("seed").value = scene.seed;
    this.showPlaying(scene.playing);
    this.showBeside(scene.beside);
  }

  /** Buttons of which one is chosen. */
  choices(id, options, choose) {
    const buttons = options.map(([value, label, colour]) => {
      const button = document.createElement("button"), dot = document.createElement("i");
      dot.style.background = colour ?? "";
      button.append(...(colour ? [dot] : []), label);
      button.setAttribute("role", "radio");
      button.addEventListener("click", () => {
        choose(value);
        buttons.forEach((other) => other.setAttribute("aria-checked", other === button));
      });
      return button;
    });
    element(id).replaceChildren(...buttons);
    buttons[0].click();
  }

  listen() {
    const on = (id, name, action) => element(id).addEventListener(name, action);
    on("play", "click", () => this.toggle());
    on("step", "click", () => this.step());
    on("restart", "click", () => this.restart());
    on("seed", "change", () => this.restart());
    on("pace", "change", () => this.setPace(Number(element("pace").value)));
    on("beside", "click", () => this.toggleBeside());
    on("save", "click", () => this.send({ do: "save" }));
    on("colour", "change", () => this.showLegend());
    on("ramp", "click", () => this.put("ramp"));
    on("disc", "click", () => this.put("disc"));
    on("remove", "click", () => this.remove());
    on("theme", "click", () => this.turnTheme());
    on("help", "click", () => element("keys").showModal());
    on("gravity", "pointerdown", (event) => element("gravity").setPointerCapture(event.pointerId));
    on("gravity", "pointermove", (event) => event.buttons && this.pullTowards(event));
    on("gravity", "keydown", (event) => this.turnByArrow(event));
    document.addEventListener("keydown", (event) => this.press(event));
  }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || element("keys").open) return;
    if (["INPUT", "SELECT"].includes(event.target.tagName) || (event.target.tagName === "BUTTON" && [" ", "Enter"].includes(event.key))) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const actions = {
      " ": () => this.toggle(), ArrowRight: () => this.step(), r: () => this.restart(), n: () => this.nextSeed(), b: () => this.toggleBeside(),
      s: () => this.send({ do: "save" }), t: () => this.turnTheme(), v: () => this.choose("tools", 0), p: () => this.choose("tools", 1),
      g: () => this.turnGravity(event.shiftKey ? -TURN : TURN), Delete: () => this.remove(), Backspace: () => this.remove(),
      c: () => this.nextColour(), "[": () => this.changePace(-1), "]": () => this.changePace(1), "?": () => element("keys").showModal(),
    };
    const action = actions[key] ?? (/^[1-9]$/.test(key) ? () => this.choose("materials", Number(key) - 1) : null);
    if (!action) return;
    event.preventDefault();
    action();
  }

  choose(id, index) { element(id).children[index]?.click(); }
  toggle() { this.showPlaying(!this.playing); this.send({ do: "play", on: this.playing }); }
  step() { this.showPlaying(false); this.send({ do: "step" }); }
  toggleBeside() { this.send({ do: "beside", on: !this.stage.beside }); }
  put(kind) { this.send({ do: "put", kind, centre: scene.bounds.map(([low, high]) => (low + high) / 2) }); }
  remove() { if (this.stage.touched != null) this.send({ do: "remove", body: this.stage.touched }); }
  turnTheme() {
    this.stage.setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
    this.showLegend(); // its scale is the theme's
  }

  restart() {
    const seed = Number(element("seed").value);
    this.send({ do: "restart", seed: Number.isInteger(seed) ? seed : -1 });
  }

  nextSeed() {
    element("seed").value = Number(element("seed").value) + 1;
    this.restart();
  }

  setPace(pace) {
    scene.pace = pace;
    element("pace").value = pace;
    this.send({ do: "pace", frames: pace });
  }

  changePace(by) { this.setPace(PACES[Math.min(Math.max(PACES.indexOf(scene.pace) + by, 0), PACES.length - 1)]); }

  touch(id) {
    this.stage.touched = id;
    element("remove").disabled = id == null;
  }

  nextColour() {
    element("colour").selectedIndex = 1 - element("colour").selectedIndex;
    this.showLegend();
  }

  showLegend() {
    const colour = element("colour").value;
    element("legend").replaceChildren(...(colour === "speed" ? colourLegend({ colour, mode: MODES.speed }) : []));
    this.stage.show();
  }

  /** Gravity towards the pointer, from the middle of its button. */
  pullTowards(event) {
    const { left, top, width, height } = element("gravity").getBoundingClientRect();
    const [x, y] = [event.clientX - left - width / 2, top + height / 2 - event.clientY], length = Math.hypot(x, y);
    if (length > 4) this.sendGravity([x / length, y / length]);
  }

  turnByArrow(event) {
    const turn = { ArrowLeft: -TURN, ArrowRight: TURN }[event.key];
    if (!turn) return;
    event.preventDefault();
    event.stopPropagation();
    this.turnGravity(turn);
  }

  turnGravity(angle) {
    if (!scene.gravityTurns) return;
    const [x, y] = scene.gravity, [c, s] = [Math.cos(angle), Math.sin(angle)], pull = Math.hypot(...scene.gravity);
    this.sendGravity([(c * x - s * y) / pull, (s * x + c * y) / pull]);
  }

  sendGravity(direction) {
    const pull = Math.hypot(...scene.gravity), vector = [direction[0] * pull, direction[1] * pull, ...scene.gravity.slice(2)];
    this.setGravity(vector);
    this.pointer.sometimes(() => this.send({ do: "gravity", vector }));
  }
}

window.play = new Play();
