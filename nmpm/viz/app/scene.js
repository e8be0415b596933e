// The scene that a page shows, how its numbers are read, and colours.

export const element = (id) => document.getElementById(id);

/** A new element with properties, and what it contains. */
export function make(tag, properties, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

/** The page's description, see page.py; one that a server sends is assigned to it. */
export const scene = JSON.parse(element("data").textContent);
/** Stands for the position of a particle that is not there. */
export const ABSENT = 65535;

/** Bytes from base64 text. */
export const readBytes = (text) => Uint8Array.from(atob(text), (character) => character.charCodeAt(0));

/** Inflates base64 text to bytes. */
export async function inflate(text) {
  const stream = new Blob([readBytes(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** 16-bit numbers of all frames from the packed differences between them; null for null. */
export async function unpack(text, frames) {
  if (text === null) return null;
  const bytes = await inflate(text), count = bytes.length / 2, values = new Uint16Array(count);
  for (let i = 0; i < count; i++) values[i] = bytes[i] | (bytes[count + i] << 8);
  for (let i = count / frames; i < count; i++) values[i] += values[i - count / frames];
  return values;
}

/** Shares of the colour scale, which runs from dark to light, that slow and fast have: fast stands out from the page. */
export const scaleEnds = () => (document.documentElement.dataset.theme === "dark" ? [0.25, 0.99] : [0.62, 0.01]);

/** #rrggbb as three numbers in [0, 1]. */
export const readColour = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
/** RGB bytes of particles from the indices of their materials. */
export const coloursOf = (materials) => {
  const colours = scene.materials.map(({ colour }) => readColour(colour).map((value) => 255 * value));
  return Uint8Array.from([...materials].flatMap((index) => colours[index]));
};
export const mix = (first, second, share) => first.map((value, at) => value + share * (second[at] - value));
export const css = (rgb) => `rgb(${rgb.map((value) => Math.round(255 * value))})`;

/** A number as text, with so many digits. */
export const digits = (value, count = 2) =>
  value === 0 || Math.abs(value) >= 1e-3 ? String(Number(value.toPrecision(count))) : value.toExponential(1);
