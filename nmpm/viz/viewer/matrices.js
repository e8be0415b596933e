// 4 × 4 matrices, stored by columns as WebGL wants them.

function multiply(a, b) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) product[4 * column + row] += a[4 * k + row] * b[4 * column + k];
  return product;
}

/** From the plane to the viewport, `scale` pixels to a unit of length, `centre` in its middle. */
function flatView(centre, scale, width, height) {
  const x = (2 * scale) / width, y = (2 * scale) / height;
  return new Float32Array([x, 0, 0, 0, 0, y, 0, 0, 0, 0, 0, 0, -x * centre[0], -y * centre[1], 0, 1]);
}

/** From space to the viewport, seen from a sphere around `centre`; `up` is the vertical axis. */
function orbitView(centre, up, turn, tilt, distance, size, width, height) {
  const forward = 1 / Math.tan(0.35), near = distance / 50, far = distance + 4 * size;
  const perspective = new Float32Array([
    (forward * height) / width, 0, 0, 0, 0, forward, 0, 0,
    0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0,
  ]);
  const [c, s, d, e] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
  // In coordinates (a, b, up) with the horizontal axes a and b, right-handed.
  const rows = [[c, s, 0], [-s * e, c * e, d], [s * d, -c * d, e]]; // right, up, toward the viewer
  const axes = [(up + 1) % 3, (up + 2) % 3, up];
  const camera = new Float32Array(16);
  rows.forEach((row, r) => row.forEach((value, k) => (camera[4 * axes[k] + r] = value)));
  rows.forEach((row, r) => {
    camera[12 + r] = -row.reduce((sum, value, k) => sum + value * centre[axes[k]], 0);
  });
  camera[14] -= distance;
  camera[15] = 1;
  return multiply(perspective, camera);
}
