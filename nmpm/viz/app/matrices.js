// 4 × 4 matrices, stored by columns as WebGL wants them.

// In 3-D: the first view, half of the camera's vertical angle, and the share of a panel that the box fills.
export const ORBIT = { turn: 0.5, tilt: 0.35, halfAngle: 0.35, filled: 0.96 };

export function multiply(a, b) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) product[4 * column + row] += a[4 * k + row] * b[4 * column + k];
  return product;
}

/** From the plane to the viewport, `scale` pixels to a unit of length, `centre` in its middle. */
export function flatView(centre, scale, width, height) {
  const x = (2 * scale) / width, y = (2 * scale) / height;
  return new Float32Array([x, 0, 0, 0, 0, y, 0, 0, 0, 0, 0, 0, -x * centre[0], -y * centre[1], 0, 1]);
}

/** Right, up and toward the viewer (rows), of a viewer turned about the vertical axis `up` and tilted above it. */
export function orbitAxes(up, turn, tilt) {
  const [c, s, d, e] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
  // In coordinates (a, b, up) with the horizontal axes a and b, right-handed.
  return [[c, s, 0], [-s * e, c * e, d], [s * d, -c * d, e]].map((row) => [0, 1, 2].map((axis) => row[(axis - up + 2) % 3]));
}

/** From space to the viewport, seen from a sphere around `centre`. */
export function orbitView(centre, up, turn, tilt, distance, size, width, height) {
  const forward = 1 / Math.tan(ORBIT.halfAngle), near = distance / 50, far = distance + 4 * size;
  const perspective = new Float32Array([
    (forward * height) / width, 0, 0, 0, 0, forward, 0, 0,
    0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0,
  ]);
  const camera = new Float32Array(16);
  orbitAxes(up, turn, tilt).forEach((row, r) => {
    row.forEach((value, axis) => (camera[4 * axis + r] = value));
    camera[12 + r] = -row.reduce((sum, value, axis) => sum + value * centre[axis], 0);
  });
  camera[14] -= distance;
  camera[15] = 1;
  return multiply(perspective, camera);
}

/** Moves points along an axis to a plane across it. */
export function flatten(axis, at) {
  const matrix = new Float32Array(16);
  for (let i = 0; i < 4; i++) matrix[5 * i] = Number(i !== axis);
  matrix[12 + axis] = at;
  return matrix;
}
