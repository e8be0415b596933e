// The page: choices, the card of a point, the budget and its advice.

const KINDS = { model: "emulators", graph: "graph networks", simulator: "simulator", trivial: "trivial", floor: "floors" };
const element = (id) => document.getElementById(id);
const trade = JSON.parse(element("data").textContent);

class Page {
  constructor() {
    this.chart = new Chart(element("chart"), (point, at) => this.showCard(point, at), () => { element("card").hidden = true; });
    this.setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    element("title").textContent = document.title = trade.title;
    element("measure").replaceChildren(...trade.measures.map(({ name, label }) => new Option(label, name)));
    element("pool").replaceChildren(...trade.pools.map((name) => new Option(name, name)));
    element("kinds").replaceChildren(...Object.entries(KINDS).map(([kind, label]) => this.checkbox(kind, label)));
    this.setRange();
    element("theme").addEventListener("click", () => this.setTheme(this.theme === "dark" ? "light" : "dark"));
    for (const control of document.querySelectorAll("select, input")) control.addEventListener("input", () => this.render());
    new ResizeObserver(() => this.render()).observe(element("chart"));
    this.render();
  }

  checkbox(kind, text) {
    const label = document.createElement("label"), box = document.createElement("input");
    Object.assign(box, { type: "checkbox", checked: true, id: `kind-${kind}` });
    label.className = kind;
    label.append(box, ` ${text}`);
    return label;
  }

  get theme() { return document.documentElement.dataset.theme; }
  setTheme(theme) { document.documentElement.dataset.theme = theme; }
  get measure() { return trade.measures.find(({ name }) => name === element("measure").value); }
  get budget() { return this.least * (this.most / this.least) ** (Number(element("budget").value) / 1000); }
  set budget(ms) {
    element("budget").value = Math.ceil(1000 * Math.log(ms / this.least) / Math.log(this.most / this.least));
    this.render();
  }

  // The slider goes from somewhat below the fastest emulator or simulator setting to somewhat above the slowest.
  setRange() {
    const times = trade.points.filter(({ kind }) => PLACED.includes(kind)).map(({ ms }) => ms[1]);
    const all = times.length ? times : trade.points.map(({ ms }) => ms[1]);
    this.least = Math.min(...all) / 2;
    this.most = Math.max(...all) * 1.2;
    element("budget").value = 500;
  }

  get shown() {
    const on = (id) => element(id).checked;
    return trade.points.filter((point) => on(`kind-${point.kind}`) && (point.batch === 1 || on("batches")) && (point.stable || on("unstable")));
  }

  get advice() {
    const steps = trade.advice[this.measure.name][element("pool").value];
    return steps.findLast(([ms]) => ms <= this.budget * 1.0001);
  }

  render() {
    const [, name, sentence] = this.advice;
    element("amount").value = `${short(this.budget)} ms per frame`;
    element("advice").textContent = sentence;
    this.chart.render(this.shown, this.measure, element("log").checked, this.budget, name);
    const below = this.chart.hidden.length ? ` Below the chart: ${this.chart.hidden.join("; ")}.` : "";
    element("about").textContent = `${trade.scenes} test scenes; ${trade.machine}. Bars: quartiles of the time, 95% of the mean error under `
      + `resampling of the scenes. Rings: the Pareto set. Pale: slower than the budget.${below}`;
  }

  showCard(point, [left, top]) {
    const card = element("card"), [mean, low, high, , probability] = point.where[this.measure.name];
    const facts = { ...point.facts, [this.measure.label]: `${short(mean)} (${short(low)} to ${short(high)})`,
      "in the Pareto set": point.stable ? `${Math.round(100 * probability)}% of resamples` : "unstable",
      ...(point.stable ? {} : { failure: `${point.failed} scenes: ${point.failure}` }) };
    const title = document.createElement("h2"), list = document.createElement("dl");
    title.textContent = point.name;
    for (const [key, value] of Object.entries(facts)) {
      list.append(Object.assign(document.createElement("dt"), { textContent: key }));
      list.append(Object.assign(document.createElement("dd"), { textContent: value }));
    }
    card.replaceChildren(title, list, ...(point.picture ? [this.picture(point)] : []));
    card.hidden = false;
    const { width, height } = element("chart").getBoundingClientRect();
    card.style.left = `${left > width / 2 ? left - card.offsetWidth - 18 : left + 18}px`;
    card.style.top = `${Math.max(4, Math.min(height - card.offsetHeight - 4, top - card.offsetHeight / 2))}px`;
  }

  // The first scene half-way: recorded particles pale, predicted ones in the kind's colour.
  picture(point) {
    const figure = document.createElement("figure"), canvas = document.createElement("canvas");
    Object.assign(canvas, { width: 260, height: 260 });
    const context = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
    for (const [packed, colour] of [[trade.truth, "--line"], [point.picture, `--${point.kind}`]]) {
      const steps = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
      context.fillStyle = style.getPropertyValue(colour);
      for (let i = 0; i < steps.length; i += 2) context.fillRect(steps[i] * 1.01, 257 - steps[i + 1] * 1.01, 3, 3);
    }
    const caption = document.createElement("figcaption");
    caption.textContent = `scene 0, frame ${trade.frame}; pale: what it should be`;
    figure.append(canvas, caption);
    return figure;
  }
}

window.page = new Page();
