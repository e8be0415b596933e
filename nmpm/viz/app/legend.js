// Legends and notes beside the drawing.

import { MODES } from "./drawing.js";
import { scaleEnds, scene } from "./scene.js";

/** What the colours of particles stand for, as elements and texts. */
export function colourLegend({ colour, mode, fieldIndex }) {
  if (colour === "material") {
    return scene.materials.map(({ name, colour: background }) => {
      const entry = document.createElement("span"), dot = document.createElement("i");
      dot.style.background = background;
      entry.append(dot, name);
      return entry;
    });
  }
  if (mode === MODES.field) {
    const { low, high } = scene.fields[fieldIndex];
    return [scaleBar([low, (low + high) / 2, high], "")];
  }
  const end = colour === "speed" ? scene.fastest / scene.dt : scene.worst;
  return [scaleBar([0, end / 4, end], colour === "speed" ? "length per second" : "length")]; // a square root: see drawing.js
}

/** The colour scale with numbers at its lower end, middle and upper end. */
function scaleBar(numbers, unit) {
  const entry = document.createElement("span"), bar = document.createElement("canvas"), context = bar.getContext("2d");
  const [from, to] = scaleEnds(), last = scene.scale.length - 1;
  entry.className = "scale";
  bar.width = scene.scale.length;
  bar.height = 1;
  for (let at = 0; at <= last; at++) {
    context.fillStyle = scene.scale[Math.round(from * last + (to - from) * at)];
    context.fillRect(at, 0, 1, 1);
  }
  const texts = numbers.map((number) => {
    const text = document.createElement("small");
    text.textContent = Number(number.toPrecision(2));
    return text;
  });
  entry.append(bar, unit, ...texts);
  return entry;
}

/** Says where gravity points: an angle from straight down, counterclockwise in radians. */
export function gravityNote(tilt) {
  const note = document.createElement("small"), arrow = document.createElement("i");
  arrow.textContent = "↓";
  arrow.style.transform = `rotate(${-tilt}rad)`;
  note.append("gravity ", arrow);
  return note;
}
