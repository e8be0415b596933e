"""Colours of materials, walls, background and text.

Materials differ in lightness as well as in hue, to be distinguishable for colour-blind readers and in print.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from types import MappingProxyType

Rgb = tuple[int, int, int]

BACKGROUND: Rgb = (255, 255, 255)
INTERIOR: Rgb = (247, 247, 247)
WALL: Rgb = (205, 209, 215)
EDGE: Rgb = (168, 174, 183)
TEXT: Rgb = (38, 42, 48)
FAINT_TEXT: Rgb = (118, 124, 133)
OBSTACLE: Rgb = (132, 138, 147)

MATERIAL_COLOURS: Mapping[str, Rgb] = MappingProxyType(
    {
        "water": (38, 112, 200),
        "fluid": (38, 112, 200),
        "sand": (230, 170, 36),
        "goop": (186, 44, 150),
        "elastic": (74, 190, 150),
        "snow": (140, 196, 230),
        "rigid": (88, 72, 64),
        "boundary": OBSTACLE,
        "wall": OBSTACLE,
        "obstacle": OBSTACLE,
        "moving wall": (94, 100, 110),
    }
)

FALLBACK_COLOURS: tuple[Rgb, ...] = (
    (210, 112, 83),
    (14, 83, 0),
    (197, 138, 255),
    (147, 198, 88),
    (128, 110, 24),
    (79, 45, 153),
)
"""For materials not in MATERIAL_COLOURS."""


def material_colours(names: Iterable[str]) -> dict[str, Rgb]:
    """The colour of each material of one scene, in the given order.

    An unknown one gets a fallback colour by its name, another one than the scene's others while there are enough.
    """
    ordered = list(dict.fromkeys(names))
    colours = {name: MATERIAL_COLOURS[name] for name in ordered if name in MATERIAL_COLOURS}
    for name in sorted(set(ordered) - set(colours)):
        start = zlib.crc32(name.encode()) % len(FALLBACK_COLOURS)
        candidates = FALLBACK_COLOURS[start:] + FALLBACK_COLOURS[:start]
        colours[name] = next((free for free in candidates if free not in colours.values()), candidates[0])
    return {name: colours[name] for name in ordered}


def hex_code(colour: Rgb) -> str:
    """A colour as #rrggbb, for matplotlib."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
