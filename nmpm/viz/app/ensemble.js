// Members of an ensemble: which of them are drawn and how, and charts of their derived quantities.

import { digits } from "./chart.js";
import { Density } from "./density.js";
import { MODES } from "./drawing.js";
import { css, element, mix, readColour, scene } from "./scene.js";

export class Ensemble {
  /** @param shown Positions of the member among the trajectories, the last of these; @param further of the others. */
  constructor(drawing, shown, further) {
    this.drawing = drawing;
    this.index = scene.trajectories.length - 1;
    this.members = [shown, ...further];
    this.labels = [scene.trajectories[this.index].label, ...scene.members.map(({ label }) => label)];
    this.strides = this.members.map((_, number) => (number ? scene.bands.stride : 1));
    if (scene.dim === 2) this.density = new Density(drawing.gl, this.members);
    this.fillChoices();
  }

  get mode() { return element("members").value; }
  get isDensity() { return this.mode === "density"; }
  get number() { return Number(this.mode) || 0; }
  get curves() { return scene.curves[Number(element("quantity").value)]; }

  fillChoices() {
    const alone = document.createElement("optgroup");
    alone.label = "one member";
    alone.append(...this.labels.map((label, number) => new Option(label, number)));
    const density = this.density ? [new Option("density", "density")] : [];
    element("members").replaceChildren(new Option("all, faint", "faint"), ...density, alone);
    element("quantity").replaceChildren(...scene.curves.map(({ name }, index) => new Option(name, index)));
    for (const id of ["members-choice", "errors", "quantity"]) element(id).hidden = false;
    document.documentElement.classList.add("ensemble");
  }

  get label() {
    const count = this.members.length;
    if (this.isDensity) return `share of ${count} members`;
    return `${this.labels[this.number]} of ${count}`;
  }

  /** Draws the members in a panel; the density is drawn by `drawBehind`. */
  draw(reference, frame, view, look) {
    if (this.isDensity) return;
    const faint = { opacity: Math.max(0.05, Math.min(0.3, 1 / this.members.length)) };
    const drawMember = (number, change) => this.drawing.drawFrame(
      this.members[number], reference, frame, view, this.memberLook(look, number, change));
    const drawOthers = () => this.members.slice(1).forEach((_, index) => drawMember(index + 1, faint));
    if (this.mode !== "faint") return drawMember(this.number);
    // In 3-D they do not hide each other, but are hidden by the first.
    if (scene.dim === 2) drawOthers();
    drawMember(0);
    if (scene.dim === 3) drawOthers();
  }

  /** Draws the density where it is chosen, behind all particles. */
  drawBehind(frame, view) {
    if (this.isDensity) this.density.draw(frame, view);
  }

  memberLook(look, number, change) {
    const hasField = look.mode !== MODES.field || number === 0;
    return { ...look, ...change, stride: this.strides[number], mode: hasField ? look.mode : MODES.material };
  }

  /** What the bands stand for, and which particles are left out. */
  legend(theme) {
    const { levels, tints, colour, stride } = scene.bands, rgb = readColour(colour), entries = [];
    if (this.isDensity) {
      const entry = document.createElement("span");
      tints.forEach((tint) => {
        const swatch = document.createElement("i");
        swatch.className = "band";
        swatch.style.background = css(mix(theme.inside, rgb, tint));
        entry.append(swatch);
      });
      entry.append(`where ${levels.map((level) => `${100 * level}`).join(", ")}% of ${this.members.length} members are`);
      entries.push(entry);
    }
    if (stride > 1)
      entries.push(`one in ${stride} particles of the other members is on this page${this.isDensity ? ", so cells are larger" : ""}`);
    return entries;
  }

  /** The chosen quantity: bands of the members, the one that is drawn, and the truth. */
  chart(frame, theme) {
    const { name, members, truth, bands } = this.curves, rgb = readColour(scene.bands.colour);
    const tinted = bands.map((band, at) => ({ ...band, colour: mix(theme.inside, rgb, scene.bands.tints[at]) }));
    const lines = [{ values: members[this.number], colour: mix(rgb, theme.text, 0.15) }];
    if (truth) lines.push({ values: truth, colour: theme.text, dashed: true });
    const now = [`${this.labels[this.number]}: ${digits(members[this.number][frame], 4)}`];
    if (truth) now.push(`${scene.trajectories[0].label}: ${digits(truth[frame], 4)} (dashed)`);
    for (const { percent, low, high } of bands) now.push(`${percent}%: ${digits(low[frame], 4)} … ${digits(high[frame], 4)}`);
    return { title: name, bands: tinted, lines, now };
  }
}
