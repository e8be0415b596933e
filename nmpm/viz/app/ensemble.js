// Members of an ensemble: which of them are drawn and how, and charts of their derived quantities.

import { Density } from "./density.js";
import { MODES } from "./drawing.js";
import { css, digits, element, make, mix, readColour, scene } from "./scene.js";

export class Ensemble {
  /** @param members Positions of the member among the trajectories, the last of these, and of the others. */
  constructor(drawing, members) {
    Object.assign(this, { drawing, members });
    this.index = scene.trajectories.length - 1;
    this.labels = [scene.trajectories[this.index], ...scene.members].map(({ label }) => label);
    if (scene.dim === 2) this.density = new Density(drawing, members);
    const alone = make("optgroup", { label: "one member" }, ...this.labels.map((label, number) => new Option(label, number)));
    const density = this.density ? [new Option("density", "density")] : [];
    element("members").replaceChildren(new Option("all, faint", "faint"), ...density, alone);
    element("quantity").replaceChildren(...scene.curves.map(({ name }, index) => new Option(name, index)));
    for (const id of ["members-choice", "errors", "quantity"]) element(id).hidden = false;
    document.documentElement.classList.add("ensemble");
  }

  get mode() { return element("members").value; }
  get isDensity() { return this.mode === "density"; }
  get number() { return Number(this.mode) || 0; }

  get label() {
    const count = this.members.length;
    return this.isDensity ? `share of ${count} members` : `${this.labels[this.number]} of ${count}`;
  }

  /** Draws the members in a panel; the density is drawn before all particles. @param frameOf The frame of a member's positions. */
  draw(frameOf, view, look) {
    if (this.isDensity) return;
    const faint = { opacity: Math.max(0.05, Math.min(0.3, 1 / this.members.length)) };
    const drawMember = (number, change) => {
      const lacksField = look.mode === MODES.field && number > 0;
      const frame = { ...frameOf(this.members[number]), stride: number ? scene.bands.stride : 1 };
      this.drawing.drawFrame(frame, view, { ...look, ...change, mode: lacksField ? MODES.material : look.mode });
    };
    const drawOthers = () => this.members.slice(1).forEach((_, index) => drawMember(index + 1, faint));
    if (this.mode !== "faint") return drawMember(this.number);
    // In 3-D they do not hide each other, but are hidden by the first.
    if (scene.dim === 2) drawOthers();
    drawMember(0);
    if (scene.dim === 3) drawOthers();
  }

  /** What the bands stand for, and which particles are left out. */
  legend(theme) {
    const { levels, tints, colour, stride } = scene.bands, entries = [];
    if (this.isDensity) {
      const style = (tint) => `background: ${css(mix(theme.inside, readColour(colour), tint))}`;
      const swatches = tints.map((tint) => make("i", { className: "band", style: style(tint) }));
      const where = `where ${levels.map((level) => `${100 * level}`).join(", ")}% of ${this.members.length} members are`;
      entries.push(make("span", {}, ...swatches, where));
    }
    if (stride > 1)
      entries.push(`one in ${stride} particles of the other members is on this page${this.isDensity ? ", so cells are larger" : ""}`);
    return entries;
  }

  /** The chosen quantity: bands of the members, the one that is drawn, and the truth. */
  chart(frame, theme) {
    const { name, members, truth, bands } = scene.curves[Number(element("quantity").value)], rgb = readColour(scene.bands.colour);
    const tinted = bands.map((band, at) => ({ ...band, colour: mix(theme.inside, rgb, scene.bands.tints[at]) }));
    const lines = [{ values: members[this.number], colour: mix(rgb, theme.text, 0.15) }];
    const now = [`${this.labels[this.number]}: ${digits(members[this.number][frame], 4)}`];
    if (truth) lines.push({ values: truth, colour: theme.text, dashed: true });
    if (truth) now.push(`${scene.trajectories[0].label}: ${digits(truth[frame], 4)} (dashed)`);
    for (const { percent, low, high } of bands) now.push(`${percent}%: ${digits(low[frame], 4)} … ${digits(high[frame], 4)}`);
    return { title: name, bands: tinted, lines, now };
  }
}
