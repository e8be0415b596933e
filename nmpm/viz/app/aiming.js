// The pointer of a page that is played with: throws blocks, pours, drags and turns ramps and discs, and in 3-D the view.

import { element, scene } from "./scene.js";

const FULL_THROW = 0.5; // share of the fastest speed that the model knows, for an arrow as long as the box
const POURED = 0.16; // the same share, of what is poured
const MOVES = 30; // milliseconds between two messages of a drag
const SLACK = 8; // pixels around a body that hold it, too
const END = 0.3; // share of a ramp's length, at each end, by which it is turned

/** Corners of a ramp or a disc as a fan of triangles. */
export function bodyCorners({ kind, centre: [x, y], radius, angle, length, thickness }) {
  if (kind === "disc")
    return Array.from({ length: 48 }, (_, i) => (i / 24) * Math.PI).map((a) => [x + radius * Math.cos(a), y + radius * Math.sin(a), 0]);
  const [c, s] = [Math.cos(angle), Math.sin(angle)], [a, b] = [length / 2, thickness / 2];
  return [[-a, -b], [a, -b], [a, b], [-a, b]].map(([p, q]) => [x + c * p - s * q, y + s * p + c * q, 0]);
}

/** How a point holds a body: "move", "turn", or nothing; `slack` widens it, for fingers. */
function holdOf({ kind, centre, radius, angle, length, thickness }, point, slack) {
  const [x, y] = [point[0] - centre[0], point[1] - centre[1]];
  if (kind === "disc") return Math.hypot(x, y) < radius + slack ? "move" : null;
  const [c, s] = [Math.cos(angle), Math.sin(angle)], [along, across] = [c * x + s * y, c * y - s * x].map(Math.abs);
  if (along > length / 2 + slack || across > thickness / 2 + slack) return null;
  return along > (0.5 - END) * length ? "turn" : "move";
}

export class Pointer {
  /** @param page Has the bodies, the chosen tool and material, and sends commands. */
  constructor(page) {
    Object.assign(this, { page, canvas: page.canvas, action: null, moved: 0 });
    const on = (name, handle) => this.canvas.addEventListener(name, handle);
    on("pointerdown", (event) => this.press(event));
    on("pointermove", (event) => this.move(event));
    on("pointerup", (event) => this.release(event, true));
    on("pointercancel", (event) => this.release(event, false));
    on("wheel", (event) => this.wheel(event));
    on("contextmenu", (event) => event.preventDefault());
  }

  /** Length of the box's shortest side. */
  get extent() { return Math.min(...scene.bounds.map(([low, high]) => high - low)); }
  /** Sides of thrown blocks. */
  get side() { return Math.max(2 * scene.spacing, this.extent * (0.03 + (0.35 * Number(element("size").value)) / 100)); }
  /** The fastest speed that the model knows. */
  get limit() { return scene.limits[this.page.material]; }
  get mayLook() { return scene.dim === 3 && this.page.tool === "look"; }

  point({ offsetX, offsetY }) { return this.page.pointAt(offsetX, offsetY); }

  /** The uppermost body at a point, and how that holds it. */
  held(point) {
    if (scene.dim !== 2) return null;
    const slack = Math.abs(this.page.pointAt(SLACK, 0)[0] - this.page.pointAt(0, 0)[0]);
    return [...this.page.bodies].reverse().map((body) => ({ body, hold: holdOf(body, point, slack) })).find(({ hold }) => hold);
  }

  press(event) {
    if (this.action) return;
    this.canvas.setPointerCapture(event.pointerId);
    const point = this.point(event), held = this.held(point);
    if (held) this.action = { kind: held.hold, body: held.body, from: point, centre: held.body.centre, angle: held.body.angle ?? 0 };
    else if (this.mayLook || (scene.dim === 3 && (event.button || event.shiftKey))) this.action = { kind: "look" };
    else if (!event.button) this.action = { kind: this.page.tool, from: point, to: point };
    this.canvas.classList.toggle("held", Boolean(held));
    if (held) this.page.touch(held.body.id);
    if (this.action?.kind === "pour") this.pour(point);
    this.drawAim();
  }

  move(event) {
    const { action } = this, point = this.point(event);
    if (!action) return this.canvas.classList.toggle("over", Boolean(this.held(point)));
    if (action.kind === "look") return this.page.drag(event);
    action.to = point;
    if (action.kind === "pour") this.sometimes(() => this.pour(point));
    else if (action.body) this.dragBody(action);
    this.drawAim();
  }

  release(event, completed) {
    const { action } = this;
    this.action = null;
    clearTimeout(this.later);
    this.canvas.classList.remove("held");
    if (action?.kind === "pour") this.page.send({ do: "stop" });
    else if (action?.kind === "throw" && completed) this.throw(action);
    else if (action?.body) this.sendBody(action.body);
    this.drawAim();
  }

  wheel(event) {
    event.preventDefault();
    const body = this.held(this.point(event))?.body, turn = Math.sign(event.deltaY);
    if (this.mayLook) return this.page.zoom(event);
    if (body?.kind !== "ramp") return (element("size").value -= 5 * turn);
    body.angle -= 0.08 * turn;
    this.sendBody(body);
    this.page.show();
  }

  throw({ from, to }) {
    const velocity = this.limited(to.map((value, axis) => ((value - from[axis]) / this.extent) * FULL_THROW * this.limit));
    this.page.send({ do: "throw", material: this.page.material, at: from, sides: from.map(() => this.side), velocity });
  }

  /** Pours along gravity, or down without it. */
  pour(at) {
    const pull = Math.hypot(...scene.gravity), down = scene.gravity.map((part, axis) => (pull ? part / pull : -Number(axis === 1)));
    const velocity = this.limited(down.map((part) => part * POURED * this.limit));
    this.page.send({ do: "pour", material: this.page.material, at, velocity, width: Math.max(2 * scene.spacing, 0.4 * this.side) });
  }

  limited(velocity) { return velocity.map((part) => Math.max(-this.limit, Math.min(this.limit, part))); }

  dragBody({ kind, body, from, to, centre, angle }) {
    const within = (value, [low, high]) => Math.max(low, Math.min(high, value));
    if (kind === "move") body.centre = centre.map((value, axis) => within(value + to[axis] - from[axis], scene.bounds[axis]));
    else {
      const [before, now] = [from, to].map(([x, y]) => Math.atan2(y - centre[1], x - centre[0]));
      body.angle = angle + now - before;
    }
    this.page.show();
    this.sometimes(() => this.sendBody(body));
  }

  sendBody({ id, centre, angle = 0 }) { this.page.send({ do: "move", body: id, centre, angle }); }

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
    let outline = "", arrow = "";
    if (this.action?.kind === "throw") {
      const [x, y, , unit] = this.page.pixelOf(this.action.from), [a, b] = this.page.pixelOf(this.action.to), side = this.side * unit;
      outline = `M${x - side / 2} ${y - side / 2}h${side}v${side}h${-side}Z`;
      const length = Math.hypot(a - x, b - y), [c, s] = [(a - x) / (length || 1), (b - y) / (length || 1)];
      if (length > 6) arrow = `M${x} ${y}L${a} ${b}M${a - 9 * c + 5 * s} ${b - 9 * s - 5 * c}L${a} ${b}L${a - 9 * c - 5 * s} ${b - 9 * s + 5 * c}`;
    }
    element("outline").setAttribute("d", outline);
    element("throw").setAttribute("d", arrow);
  }
}
