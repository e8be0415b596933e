// The error curve under the time slider.

const digits = (value) => (value === 0 || value >= 1e-3 ? String(Number(value.toPrecision(2))) : value.toExponential(1));

/** Draws the curves of all predictions against time, with a line at the frame. */
function drawCurve(canvas, errors, colours, frame, theme) {
  const ratio = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  const highest = Math.max(...errors.flat(), 1e-30), last = Math.max(scene.frames - 1, 1);
  const x = (f) => 8 + (f / last) * (width - 16), y = (error) => height - 3 - (error / highest) * (height - 18);
  const css = (rgb) => `rgb(${rgb.map((value) => Math.round(255 * value))})`;
  context.strokeStyle = css(theme.line);
  context.strokeRect(0.5, 0.5, width - 1, height - 1);
  errors.forEach((curve, index) => {
    context.strokeStyle = css(colours[index]);
    context.lineWidth = 1.5;
    context.beginPath();
    curve.forEach((error, f) => (f ? context.lineTo(x(f), y(error)) : context.moveTo(x(f), y(error))));
    context.stroke();
  });
  context.fillStyle = css(theme.faint);
  context.font = "11px system-ui, sans-serif";
  context.fillText(`root mean square error, up to ${digits(highest)}`, 12, 13);
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
