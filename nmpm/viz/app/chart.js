// The chart under the time slider.

import { css, digits, scene } from "./scene.js";

const BESIDE = { left: 52, right: 10, top: 18, bottom: 17 }; // the axes, in pixels

/** Some round numbers between two ends. */
function roundTicks(low, high, most) {
  const least = (high - low) / most, power = 10 ** Math.floor(Math.log10(least));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= least), first = Math.ceil(low / step);
  return Array.from({ length: Math.floor(high / step) - first + 1 }, (_, i) => (first + i) * step);
}

/**
 * Draws curves against frames, with a line at the one that is shown.
 * @param chart {title, bands: [{low, high, colour}], lines: [{values, colour, dashed}]}, of all frames.
 */
export function drawCurve(canvas, { title, bands, lines }, frame, theme) {
  const ratio = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  const all = [...lines.map(({ values }) => values), ...bands.flatMap(({ low, high }) => [low, high])].flat();
  const lowest = bands.length ? Math.min(...all) : 0, highest = Math.max(...all, lowest + 1e-30);
  const { left, right, top, bottom } = BESIDE, last = Math.max(scene.frames - 1, 1), foot = height - bottom;
  const x = (f) => left + (f / last) * (width - left - right), y = (value) => foot - ((value - lowest) / (highest - lowest)) * (foot - top);
  const follow = (values) => values.forEach((value, f) => context.lineTo(x(f), y(value)));
  const draw = (colour, along) => {
    context.strokeStyle = css(colour);
    context.beginPath();
    along();
    context.stroke();
  };
  const segment = (x0, y0, x1, y1) => () => { context.moveTo(x0, y0); context.lineTo(x1, y1); };
  context.font = "11px system-ui, sans-serif";
  context.fillStyle = css(theme.text);
  context.fillText(title, left, 11);
  context.fillStyle = css(theme.faint);
  context.textAlign = "right";
  for (const value of roundTicks(lowest, highest, 3)) {
    draw(theme.line, segment(left, Math.round(y(value)) + 0.5, width - right, Math.round(y(value)) + 0.5));
    context.fillText(digits(value, 3), left - 5, y(value) + 4);
  }
  context.textAlign = "center";
  for (const tick of roundTicks(0, last * scene.every, width / 110)) context.fillText(tick, x(tick / scene.every), height - 4);
  for (const { low, high, colour } of bands) {
    context.fillStyle = css(colour);
    context.beginPath();
    follow(low);
    for (let f = scene.frames - 1; f >= 0; f--) context.lineTo(x(f), y(high[f]));
    context.fill();
  }
  context.lineWidth = 1.5;
  for (const { values, colour, dashed } of lines) {
    context.setLineDash(dashed ? [5, 3] : []);
    draw(colour, () => follow(values));
  }
  context.setLineDash([]);
  context.lineWidth = 1;
  draw(theme.text, segment(x(frame), top - 4, x(frame), foot));
}

/** The frame under a point of the curve. */
export function frameAt(canvas, offset) {
  const share = (offset - BESIDE.left) / (canvas.clientWidth - BESIDE.left - BESIDE.right);
  return Math.round(Math.min(1, Math.max(0, share)) * (scene.frames - 1));
}
