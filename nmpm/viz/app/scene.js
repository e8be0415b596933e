// Reading the page's data: trajectories as differences of 16-bit positions from frame to frame, deflated.

/** The page's description: title, labels, materials, box; see page.py. */
export const scene = JSON.parse(document.getElementById("data").textContent);

export const element = (id) => document.getElementById(id);
export const THEME_COLOURS = ["page", "text", "faint", "line", "inside", "wall", "ghost", "accent"];
export const MOST_PIXELS = 2; // along each axis, to a pixel of the page: phones have 3, which nobody sees in discs

/** Inflates base64 text to bytes. */
export async function inflate(text) {
  const packed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** 16-bit positions (frames × particles × axes) from their differences, all low bytes before all high bytes. */
export function undoDifferences(bytes, frames) {
  const count = bytes.length / 2;
  const positions = new Uint16Array(count);
  for (let i = 0; i < count; i++) positions[i] = bytes[i] | (bytes[count + i] << 8);
  for (let i = count / frames; i < count; i++) positions[i] += positions[i - count / frames];
  return positions;
}

/** Positions of one trajectory, in 65535ths of `scene.low` … `scene.high`. */
export async function readTrajectory(trajectory) {
  return undoDifferences(await inflate(trajectory.positions), scene.frames);
}

/** A field's values of one trajectory, frames × particles, in 65535ths of its colour scale; null where it has none. */
export async function readField(packed) {
  return packed && undoDifferences(await inflate(packed), scene.frames);
}

/** Shares of the colour scale, which runs from dark to light, that slow and fast have: fast stands out from the page. */
export const scaleEnds = () => (document.documentElement.dataset.theme === "dark" ? [0.25, 0.99] : [0.62, 0.01]);

/** #rrggbb as three numbers in [0, 1]. */
export function readColour(hex) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
}

export const mix = (first, second, share) => first.map((value, at) => value + share * (second[at] - value));
export const css = (rgb) => `rgb(${rgb.map((value) => Math.round(255 * value))})`;
