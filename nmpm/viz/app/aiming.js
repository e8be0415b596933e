// The pointer: throws blocks, pours, drags and turns bodies, and in 3-D the view.

import { holdOf } from "./bodies.js";
import { element, scene } from "./scene.js";

const FULL_THROW = 0.5; // share of the fastest speed that the model knows, for an arrow as long as the box
const MOVES = 30; // milliseconds between two messages of a drag
const SLACK = 8; // pixels around a body that hold it, too

export class Pointer {
  /** @param send Sends a command; @param choice {tool, material} as chosen on the page. */
  constructor(stage, send, choice) {
    Object.assign(this, { stage, send, choice, action: null, moved: 0 });
    const canvas = stage.canvas, on = (name, handle) => canvas.addEventListener(name, handle);
    on("pointerdown", (event) => this.press(event));
    on("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) on(name, (event) => this.release(event, name === "pointerup"));
    on("wheel", (event) => this.wheel(event));
    on("contextmenu", (event) => event.preventDefault());
  }

  /** Length of the box's shortest side. */
  get extent() { return Math.min(...scene.bounds.map(([low, high]) => high - low)); }
  get side() { return Math.max(2 * scene.spacing, this.extent * (0.03 + (0.35 * Number(element("size").value)) / 100)); }
  get width() { return Math.max(2 * scene.spacing, 0.4 * this.side); }

  point(event) { return this.stage.pointAt(event.offsetX, event.offsetY); }

  held(point) {
    if (scene.dim !== 2) return null;
    const [a, b] = [this.stage.pointAt(0, 0), this.stage.pointAt(SLACK, 0)], slack = Math.abs(b[0] - a[0]);
    for (const body of [...this.stage.bodies].reverse()) {
      const hold = holdOf(body, point, slack);
      if (hold) return { body, hold };
    }
    return null;
  }

  press(event) {
    if (this.action) return;
    this.stage.canvas.setPointerCapture(event.pointerId);
    const point = this.point(event), held = this.held(point);
    const look = scene.dim === 3 && (event.button || event.shiftKey || this.choice.tool === "look");
    if (held) this.action = { kind: held.hold, body: held.body, from: point, centre: held.body.centre, angle: held.body.angle ?? 0 };
    else if (look) this.action = { kind: "look" };
    else if (!event.button) this.action = { kind: this.choice.tool, from: point, to: point };
    this.stage.canvas.classList.toggle("held", Boolean(held));
    if (held) this.choice.touch(held.body.id);
    if (this.action?.kind === "pour") this.pour(point);
    this.drawAim();
  }

  move(event) {
    const { action } = this, point = this.point(event);
    if (!action) return this.stage.canvas.classList.toggle("over", Boolean(this.held(point)));
    if (action.kind === "look") {
      this.stage.camera.drag(event.movementX, event.movementY, 1, 1);
      return this.stage.show();
    }
    action.to = point;
    if (action.kind === "pour") this.sometimes(() => this.pour(point));
    else if (action.kind !== "throw") this.dragBody(action, point);
    this.drawAim();
  }

  release(event, completed) {
    const { action } = this;
    this.action = null;
    clearTimeout(this.later);
    this.stage.canvas.classList.remove("held");
    if (action?.kind === "pour") this.send({ do: "stop" });
    else if (action?.kind === "throw" && completed) this.throw(action);
    else if (action?.body) this.sendBody(action.body);
    this.drawAim();
  }

  wheel(event) {
    event.preventDefault();
    const held = this.held(this.point(event)), turn = Math.sign(event.deltaY);
    if (held?.body.kind === "ramp") {
      held.body.angle -= 0.08 * turn;
      this.sendBody(held.body);
      this.stage.show();
    } else if (scene.dim === 3 && this.choice.tool === "look") {
      this.stage.camera.zoomBy(Math.exp(-event.deltaY / 500), 0, 0, 1, 1);
      this.stage.show();
    } else element("size").value = Number(element("size").value) - 5 * turn;
  }

  throw({ from, to }) {
    const velocity = this.limited(to.map((value, axis) => ((value - from[axis]) / this.extent) * FULL_THROW * this.limit));
    this.send({ do: "throw", material: this.choice.material, at: from, sides: from.map(() => this.side), velocity });
  }

  /** Pours along gravity, a third as fast as a full throw. */
  pour(point) {
    const pull = Math.hypot(...scene.gravity), down = pull ? scene.gravity.map((g) => g / pull) : scene.bounds.map((_, axis) => -Number(axis === 1));
    const velocity = this.limited(down.map((part) => part * 0.16 * this.limit));
    this.send({ do: "pour", material: this.choice.material, at: point, velocity, width: this.width });
  }

  get limit() { return scene.limits[this.choice.material]; }
  limited(velocity) { return velocity.map((part) => Math.max(-this.limit, Math.min(this.limit, part))); }

  dragBody({ kind, body, from, centre, angle }, point) {
    if (kind === "move") body.centre = this.within(centre.map((value, axis) => value + point[axis] - from[axis]));
    else {
      const [before, now] = [from, point].map(([x, y]) => Math.atan2(y - centre[1], x - centre[0]));
      body.angle = angle + now - before;
    }
    this.stage.show();
    this.sometimes(() => this.sendBody(body));
  }

  within(point) { return point.map((value, axis) => Math.max(scene.bounds[axis][0], Math.min(scene.bounds[axis][1], value))); }

  sendBody({ id, centre, angle = 0 }) { this.send({ do: "move", body: id, centre, angle }); }

  /** Does something now, or a little later if something was done a moment ago; of several that wait, the last. */
  sometimes(doIt) {
    clearTimeout(this.later);
    const wait = this.moved + MOVES - performance.now();
    if (wait > 0) return (this.later = setTimeout(() => this.sometimes(doIt), wait));
    this.moved = performance.now();
    doIt();
  }

  /** The block to be thrown, and an arrow for its velocity. */
  drawAim() {
    const { action, stage } = this, throwing = action?.kind === "throw";
    let outline = "", arrow = "";
    if (throwing) {
      const [x, y] = stage.pixelOf(action.from), [a, b] = stage.pixelOf(action.to), half = this.pixels(this.side) / 2;
      outline = `M${x - half} ${y - half}h${2 * half}v${2 * half}h${-2 * half}Z`;
      const length = Math.hypot(a - x, b - y), [c, s] = [(a - x) / (length || 1), (b - y) / (length || 1)];
      if (length > 6) arrow = `M${x} ${y}L${a} ${b}M${a - 9 * c + 5 * s} ${b - 9 * s - 5 * c}L${a} ${b}L${a - 9 * c - 5 * s} ${b - 9 * s + 5 * c}`;
    }
    element("outline").setAttribute("d", outline);
    element("throw").setAttribute("d", arrow);
  }

  pixels(length) {
    const { width, height } = this.stage.panels()[0], depth = scene.dim === 3 ? (1.4 * Math.hypot(...this.stage.camera.sizes)) / this.stage.camera.zoom : 1;
    return (length * this.stage.camera.view(width, height).unit) / depth;
  }
}
