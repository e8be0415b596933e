// The chart under the time slider.

const digits = (value, count = 2) =>
  value === 0 || Math.abs(value) >= 1e-3 ? String(Number(value.toPrecision(count))) : value.toExponential(1);

/**
 * Draws curves against time, with a line at the frame.
 * @param chart {title, bands: [{low, high, colour}], lines: [{values, colour, dashed}]}, of all frames.
 */
function drawCurve(canvas, { title, bands, lines }, frame, theme) {
  const ratio = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  const all = [...lines.map(({ values }) => values), ...bands.flatMap(({ low, high }) => [low, high])].flat();
  const lowest = bands.length ? Math.min(...all) : 0, highest = Math.max(...all, lowest + 1e-30);
  const last = Math.max(scene.frames - 1, 1), y = (value) => height - 3 - ((value - lowest) / (highest - lowest)) * (height - 22);
  const x = (f) => 8 + (f / last) * (width - 16), follow = (values) => values.forEach((value, f) => context.lineTo(x(f), y(value)));
  context.strokeStyle = css(theme.line);
  context.strokeRect(0.5, 0.5, width - 1, height - 1);
  for (const { low, high, colour } of bands) {
    context.fillStyle = css(colour);
    context.beginPath();
    follow(low);
    for (let f = scene.frames - 1; f >= 0; f--) context.lineTo(x(f), y(high[f]));
    context.fill();
  }
  for (const { values, colour, dashed } of lines) {
    context.strokeStyle = css(colour);
    context.lineWidth = 1.5;
    context.setLineDash(dashed ? [5, 3] : []);
    context.beginPath();
    follow(values);
    context.stroke();
  }
  context.setLineDash([]);
  context.fillStyle = css(theme.faint);
  context.font = "11px system-ui, sans-serif";
  context.fillText(`${title}, ${lowest ? `${digits(lowest, 3)} to` : "up to"} ${digits(highest, bands.length ? 3 : 2)}`, 12, 13);
  context.strokeStyle = css(theme.text);
  context.lineWidth = 1;
  context.beginPath();
  context.moveTo(x(frame), 0);
  context.lineTo(x(frame), height);
  context.stroke();
}

/** The frame under a point of the curve. */
function frameAt(canvas, offset) {
  const share = (offset - 8) / (canvas.clientWidth - 16);
  return Math.round(Math.min(1, Math.max(0, share)) * (scene.frames - 1));
}
