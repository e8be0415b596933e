// What the colours of particles stand for.

import { make, scaleEnds, scene } from "./scene.js";

/** The legend of the materials, of speeds or errors, or of a field, by the value of the choice of colours. */
export function colourLegend(colour) {
  const field = scene.fields[Number(colour.replace("field ", ""))];
  if (colour === "material")
    return scene.materials.map(({ name, colour: background }) => make("span", {}, make("i", { style: `background: ${background}` }), name));
  if (field) return [scaleBar([field.low, (field.low + field.high) / 2, field.high], "")];
  const end = colour === "speed" ? scene.fastest / scene.dt : scene.worst;
  return [scaleBar([0, end / 4, end], colour === "speed" ? "length per second" : "length")]; // a square root: see drawing.js
}

/** The colour scale with numbers at its lower end, middle and upper end. */
function scaleBar(numbers, unit) {
  const bar = make("canvas", { width: scene.scale.length, height: 1 }), context = bar.getContext("2d");
  const [from, to] = scaleEnds(), last = scene.scale.length - 1;
  for (let at = 0; at <= last; at++) {
    context.fillStyle = scene.scale[Math.round(from * last + (to - from) * at)];
    context.fillRect(at, 0, 1, 1);
  }
  const texts = numbers.map((number) => make("small", {}, Number(number.toPrecision(2))));
  return make("span", { className: "scale" }, bar, unit, ...texts);
}
