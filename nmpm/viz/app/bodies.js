// Ramps and discs: their outlines, and whether a point is on them.

const END = 0.3; // share of a ramp's length, at each end, by which it is turned

/** A point along a ramp's axes, from its centre. */
function alongRamp({ centre, angle }, [x, y]) {
  const [dx, dy] = [x - centre[0], y - centre[1]], [c, s] = [Math.cos(angle), Math.sin(angle)];
  return [c * dx + s * dy, c * dy - s * dx];
}

/** Corners of a body as a strip or fan of triangles. */
function bodyCorners(body) {
  const [x, y] = body.centre;
  if (body.kind === "disc")
    return Array.from({ length: 48 }, (_, i) => (i / 24) * Math.PI).map((a) => [x + body.radius * Math.cos(a), y + body.radius * Math.sin(a), 0]);
  const [c, s] = [Math.cos(body.angle), Math.sin(body.angle)], [a, b] = [body.length / 2, body.thickness / 2];
  return [[-a, -b], [a, -b], [a, b], [-a, b]].map(([p, q]) => [x + c * p - s * q, y + s * p + c * q, 0]);
}

export function drawBody(drawing, body, colour) {
  drawing.drawCorners(bodyCorners(body), drawing.gl.TRIANGLE_FAN, colour);
}

/** How a point holds a body: "move", "turn", or nothing; `slack` widens it, for fingers. */
export function holdOf(body, point, slack) {
  if (body.kind === "disc")
    return Math.hypot(point[0] - body.centre[0], point[1] - body.centre[1]) < body.radius + slack ? "move" : null;
  const [along, across] = alongRamp(body, point).map(Math.abs);
  if (along > body.length / 2 + slack || across > body.thickness / 2 + slack) return null;
  return along > (0.5 - END) * body.length ? "turn" : "move";
}
