// The chart: emulators as discs, graph networks as triangles, simulator settings as squares, trivial predictors and floors as lines.

const PLACED = ["model", "graph", "simulator"]; // kinds that are points
const MARGIN = { left: 74, right: 22, top: 12, bottom: 44 };

class Chart {
  constructor(svg, show, hide) { Object.assign(this, { svg, show, hide }); }

  // points: those to show; measure: name and label; budget in ms; advised: a point's name.
  render(points, measure, logarithmic, budget, advised) {
    const { width, height } = this.svg.getBoundingClientRect();
    this.svg.replaceChildren();
    const value = (point) => point.where[measure.name];
    const known = points.filter(value);
    const placed = known.filter((point) => PLACED.includes(point.kind));
    const levels = known.filter((point) => ["trivial", "floor"].includes(point.kind) && value(point)[0] > 0);
    const visible = placed.filter((point) => !point.exact);
    // A floor far below all points would squeeze them; it is left out, and the page says so.
    const least = Math.min(...visible.map((point) => value(point)[1]).filter((low) => low > 0));
    const near = levels.filter((point) => value(point)[0] > least / 100 || !logarithmic);
    const x = makeAxis(placed.flatMap((point) => point.ms), MARGIN.left, width - MARGIN.right, logarithmic);
    const heights = [...visible.flatMap((point) => value(point).slice(0, 3)), ...near.map((point) => value(point)[0])];
    const y = makeAxis(heights, height - MARGIN.bottom, MARGIN.top, logarithmic);
    Object.assign(this, { x, y });
    this.drawAxes(x, y, width, height, measure);
    near.forEach((point, index) => this.drawLevel(point, value(point)[0], y, width, index % 2 === 1));
    for (const point of placed.filter((one) => one.exact && one.kind === "simulator")) this.drawExact(point, x, height);
    const limit = Math.min(width - MARGIN.right, Math.max(MARGIN.left, x.at(Math.max(budget, x.low))));
    draw(this.svg, "line", { id: "limit", x1: limit, x2: limit, y1: MARGIN.top, y2: height - MARGIN.bottom });
    for (const point of visible) this.drawPoint(point, value(point), x, y, point.ms[1] > budget * 1.0001, point.name === advised);
    this.hidden = levels.filter((point) => !near.includes(point)).map((point) => `${point.name}: ${short(value(point)[0])}`);
  }

  drawAxes(x, y, width, height, measure) {
    const bottom = height - MARGIN.bottom;
    for (const tick of x.ticks) {
      draw(this.svg, "line", { class: "grid", x1: x.at(tick), x2: x.at(tick), y1: MARGIN.top, y2: bottom });
      draw(this.svg, "text", { x: x.at(tick), y: bottom + 17, "text-anchor": "middle" }, short(tick));
    }
    for (const tick of y.ticks) {
      draw(this.svg, "line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: y.at(tick), y2: y.at(tick) });
      draw(this.svg, "text", { x: MARGIN.left - 8, y: y.at(tick) + 4, "text-anchor": "end" }, short(tick));
    }
    draw(this.svg, "text", { x: (MARGIN.left + width) / 2, y: height - 8, "text-anchor": "middle" }, "milliseconds per frame and scene");
    draw(this.svg, "text", { transform: `translate(16 ${height / 2}) rotate(-90)`, "text-anchor": "middle" }, measure.label);
  }

  drawLevel(point, error, y, width, onTheLeft) {
    const group = draw(this.svg, "g", { class: `level ${point.kind}` });
    draw(group, "line", { x1: MARGIN.left, x2: width - MARGIN.right, y1: y.at(error), y2: y.at(error) });
    const place = onTheLeft ? { x: MARGIN.left + 4, "text-anchor": "start" } : { x: width - MARGIN.right - 4, "text-anchor": "end" };
    draw(group, "text", { class: "label", y: y.at(error) - 5, ...place }, point.name);
  }

  drawExact(point, x, height) {
    const group = draw(this.svg, "g", { class: "level simulator" }), at = x.at(point.ms[1]);
    draw(group, "line", { class: "exact", x1: at, x2: at, y1: MARGIN.top, y2: height - MARGIN.bottom });
    draw(group, "text", { class: "label", transform: `translate(${at - 6} ${height / 2}) rotate(-90)`, "text-anchor": "middle" },
      `${point.name}: as it made the data, error 0`);
  }

  drawPoint(point, [mean, low, high, member], x, y, slow, advised) {
    const at = [x.at(point.ms[1]), y.at(mean)], classes = ["point", point.kind, slow ? "slow" : "", point.stable ? "" : "failed"];
    const group = draw(this.svg, "g", { class: classes.join(" "), tabindex: 0, "data-name": point.name });
    if (low > 0 || y.low === 0) draw(group, "line", { class: "bar", x1: at[0], x2: at[0], y1: y.at(low), y2: y.at(high) });
    draw(group, "line", { class: "bar", x1: x.at(point.ms[0]), x2: x.at(point.ms[2]), y1: at[1], y2: at[1] });
    draw(group, "circle", { class: "halo", cx: at[0], cy: at[1], r: 13 });
    if (member) draw(group, "circle", { class: "ring", cx: at[0], cy: at[1], r: 10 });
    const r = advised ? 7 : 5;
    if (point.kind === "model") draw(group, "circle", { class: "mark", cx: at[0], cy: at[1], r });
    else if (point.kind === "graph") draw(group, "path", { class: "mark", d: `M${at[0] - r} ${at[1] + r}h${2 * r}l${-r} ${-2 * r}z` });
    else draw(group, "rect", { class: "mark", x: at[0] - r, y: at[1] - r, width: 2 * r, height: 2 * r });
    const name = point.name.replace(/^simulator, /, "");
    if (member || advised) draw(group, "text", { class: "label", x: at[0] + 12, y: at[1] - 6 }, name);
    for (const event of ["mouseenter", "focus"]) group.addEventListener(event, () => this.show(point, at));
    for (const event of ["mouseleave", "blur"]) group.addEventListener(event, () => this.hide());
  }
}
