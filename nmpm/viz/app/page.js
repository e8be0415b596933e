// What all pages have: a canvas with panels, labels above and a legend below them, a theme, and controls.

import { Camera, panelRectangles, project } from "./camera.js";
import { DISC_DIAMETER, Drawing, MODES } from "./drawing.js";
import { element, make, readColour, scaleEnds, scene } from "./scene.js";

const THEME_COLOURS = ["page", "text", "faint", "line", "inside", "wall", "ghost", "accent"];
const MOST_PIXELS = 2; // along each axis, to a pixel of the page: phones have 3, which nobody sees in discs
const HEAD = 26; // pixels above each panel, for its label
const SAID = 6000; // milliseconds that a line stays

/** The option after the chosen one, in a circle. */
export const next = (choice) => choice.options[(choice.selectedIndex + 1) % choice.options.length].value;

/**
 * A page. Modes say what it shows: `shown`, a list of what each panel shows, and for one of these `labelOf`, `drawBehind` and
 * `drawContents`. Controls call the method that their attribute `data-do` names, when they are clicked, on the event `data-on`,
 * or when one of the keys `data-keys` is pressed; in the list of keys, by these alone.
 */
export class Page {
  /** @param obstacles 16-bit positions. */
  constructor(obstacles) {
    this.canvas = element("scene");
    this.camera = new Camera();
    this.drawing = new Drawing(this.canvas, obstacles);
    this.drawn = 0;
    element("title").textContent = document.title = scene.title;
    element("message").hidden = true;
    this.setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    for (const control of document.querySelectorAll("[data-do]"))
      if (!control.closest("dl")) control.addEventListener(control.dataset.on ?? "click", (event) => this[control.dataset.do](event));
    document.addEventListener("keydown", (event) => this.press(event));
    new ResizeObserver(() => this.show()).observe(this.canvas);
  }

  get colour() { return element("colour").value; }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || element("keys").open) return;
    if (event.target.matches("select, #size, #seed")) return;
    if (event.target.tagName === "BUTTON" && [" ", "Enter"].includes(event.key)) return; // it presses the button
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const control = [...document.querySelectorAll("[data-keys]")].find(({ dataset }) => dataset.keys === key);
    if (!control || control.closest("[hidden]")) return;
    event.preventDefault();
    if (control.dataset.do) this[control.dataset.do](event);
    else control.click();
  }

  showKeys() { element("keys").showModal(); }

  /** Shows a line for some seconds. */
  say(text, kind = "") {
    const line = element("say");
    Object.assign(line, { textContent: text, className: kind, hidden: false });
    clearTimeout(this.saying);
    this.saying = setTimeout(() => (line.hidden = true), SAID);
  }

  showPlaying(on) {
    this.playing = on;
    element("play").classList.toggle("playing", on);
    element("play").setAttribute("aria-label", on ? "Pause" : "Play");
  }

  turnTheme() {
    this.setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
    this.showLegend(); // its scale is the theme's
  }

  setTheme(name) {
    document.documentElement.dataset.theme = name;
    const style = getComputedStyle(document.documentElement);
    this.theme = Object.fromEntries(
      THEME_COLOURS.map((colour) => [colour, readColour(style.getPropertyValue(`--${colour}`).trim())]));
  }

  nextColour() { this.setColour(next(element("colour"))); }

  setColour(name) {
    element("colour").value = name;
    this.showLegend();
  }

  showLegend() {
    element("legend").replaceChildren(...this.legend());
    this.show();
  }

  legend() { return colourLegend(this.colour); }

  reset() {
    this.camera.reset();
    this.show();
  }

  /** The panels, in pixels of the page: what each shows, and where it lies. */
  panels() {
    const { clientWidth, clientHeight } = this.canvas, shown = this.shown;
    const places = panelRectangles(shown.length, clientWidth, clientHeight - HEAD, this.camera.aspect), lower = places.at(-1)[1] > 0;
    return places.map(([x, y, width, height], i) => ({ shown: shown[i], x, y: y + HEAD, width, height: height - (lower ? HEAD : 0) }));
  }

  panelUnder({ offsetX, offsetY }) {
    const panels = this.panels();
    return panels.find(({ x, y, width, height }) => offsetX >= x && offsetX < x + width && offsetY >= y && offsetY < y + height) ?? panels[0];
  }

  /** A function from points of the scene to [x, y, order in depth, pixels of a length of 1 there] in a panel. */
  projection({ x, y, width, height }) {
    const { matrix, unit } = this.camera.view(width, height);
    return (point) => {
      const [right, up, depth, w] = project(matrix, point);
      return [x + (width * (1 + right / w)) / 2, y + (height * (1 - up / w)) / 2, depth / w, unit / w];
    };
  }

  drag(event) {
    const { width, height } = this.panelUnder(event);
    this.camera.drag(event.movementX, event.movementY, width, height);
    this.show();
  }

  zoom(event) {
    event.preventDefault();
    const { x, y, width, height } = this.panelUnder(event);
    const [right, above] = [event.offsetX - x - width / 2, y + height / 2 - event.offsetY];
    this.camera.zoomBy(Math.exp(-event.deltaY / 500), right, above, width, height);
    this.show();
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
    const { canvas } = this, ratio = Math.min(devicePixelRatio, MOST_PIXELS), gl = this.drawing.gl;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.round(length * ratio));
    // Setting a size, even the same, would allocate the picture anew.
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(...this.theme.page, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const panels = this.panels();
    panels.forEach((panel) => this.drawPanel(panel, ratio));
    element("labels").replaceChildren(...panels.map(({ shown, x, y, width: room }) =>
      make("span", { style: `left: ${x + room / 2}px; top: ${y - 24}px; max-width: ${room - 8}px` }, ...this.labelOf(shown))));
    this.drawn += 1;
  }

  drawPanel({ shown, x, y, width, height }, ratio) {
    const pixels = [x, this.canvas.height / ratio - y - height, width, height].map((value) => Math.round(value * ratio));
    const { matrix, unit } = this.camera.view(width, height), diameter = DISC_DIAMETER * scene.spacing * unit * ratio;
    const plain = { mode: MODES.plain, plain: [...this.theme.ghost, 1], diameter };
    this.drawing.startPanel(pixels, matrix, this.theme);
    this.drawBehind(shown, matrix);
    this.drawing.drawFrame({ position: this.drawing.obstacles }, matrix, plain);
    this.drawContents(shown, matrix, { ...plain, mode: MODES[this.colour] ?? MODES.field });
  }
}

/** The legend of the materials, of speeds or errors, or of a field, by the value of the choice of colours. */
function colourLegend(colour) {
  const field = scene.fields[Number(colour.replace("field ", ""))];
  if (colour === "material")
    return scene.materials.map(({ name, colour: background }) => make("span", {}, make("i", { style: `background: ${background}` }), name));
  if (field) return [scaleBar([field.low, (field.low + field.high) / 2, field.high], "")];
  const end = colour === "speed" ? scene.fastest / scene.dt : scene.worst;
  return [scaleBar([0, end / 4, end], colour === "speed" ? "length per second" : "length")]; // a square root: see drawing.js
}

/** The colour scale with numbers at its lower end, middle and upper end. */
function scaleBar(numbers, unit) {
  const bar = make("canvas", { width: scene.scale.length, height: 1 }), context = bar.getContext("2d");
  const [from, to] = scaleEnds(), last = scene.scale.length - 1;
  for (let at = 0; at <= last; at++) {
    context.fillStyle = scene.scale[Math.round(from * last + (to - from) * at)];
    context.fillRect(at, 0, 1, 1);
  }
  const texts = numbers.map((number) => make("small", {}, Number(number.toPrecision(2))));
  return make("span", { className: "scale" }, bar, unit, ...texts);
}
