// Legends and notes beside the drawing.

/** What the colours of particles stand for, as elements and texts. */
function colourLegend({ colour, mode, fieldIndex }) {
  if (colour === "material") {
    return scene.materials.map(({ name, colour: background }) => {
      const entry = document.createElement("span"), dot = document.createElement("i");
      dot.style.background = background;
      entry.append(dot, name);
      return entry;
    });
  }
  const bar = document.createElement("canvas"), context = bar.getContext("2d");
  bar.width = scene.scale.length;
  bar.height = 1;
  scene.scale.forEach((hex, at) => {
    context.fillStyle = hex;
    context.fillRect(at, 0, 1, 1);
  });
  if (mode === MODES.field) {
    const { low, high } = scene.fields[fieldIndex];
    return [`${Number(low.toPrecision(4))} or less`, bar, `${Number(high.toPrecision(4))} or more`];
  }
  const unit = colour === "speed" ? "length per second" : "length";
  const end = colour === "speed" ? scene.fastest / scene.dt : scene.worst;
  return ["0", bar, `${Number(end.toPrecision(2))} ${unit} or more`];
}

/** Says where gravity points: an angle from straight down, counterclockwise in radians. */
function gravityNote(tilt) {
  const note = document.createElement("small"), arrow = document.createElement("i");
  arrow.textContent = "↓";
  arrow.style.transform = `rotate(${-tilt}rad)`;
  note.append("gravity ", arrow);
  return note;
}
