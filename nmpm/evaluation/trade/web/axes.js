// Axes: from values to pixels, linear or logarithmic, and their ticks.

const SVG = "http://www.w3.org/2000/svg";

function draw(parent, name, attributes, text) {
  const made = parent.appendChild(document.createElementNS(SVG, name));
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

function makeAxis(values, from, to, logarithmic) {
  const positive = values.filter((value) => value > 0);
  let low = Math.min(...positive), high = Math.max(...positive);
  if (!positive.length) [low, high] = [0.1, 1];
  [low, high] = logarithmic ? [low / 1.3, high * 1.3] : [0, high * 1.06];
  const bend = logarithmic ? Math.log10 : (value) => value;
  const at = (value) => from + (bend(value) - bend(low)) / (bend(high) - bend(low)) * (to - from);
  return { low, high, at, ticks: logarithmic ? logTicks(low, high) : linearTicks(high) };
}

function logTicks(low, high) {
  const ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++)
    for (const digit of [1, 2, 5]) ticks.push(digit * 10 ** power);
  const inside = ticks.filter((tick) => tick >= low && tick <= high);
  const tens = inside.filter((tick) => Math.abs(Math.log10(tick) % 1) < 1e-9);
  return inside.length > 9 && tens.length > 2 ? tens : inside;
}

function linearTicks(high) {
  const step = [1, 2, 5, 10].map((digit) => digit * 10 ** Math.floor(Math.log10(high / 4))).find((s) => high / s <= 6);
  return Array.from({ length: Math.floor(high / step) + 1 }, (_, index) => index * step);
}

const short = (value) => String(Number(value.toPrecision(3)));
