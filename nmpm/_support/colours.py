"""Colours of materials, walls, background and text.

Materials differ in lightness as well as in hue, to be distinguishable for colour-blind readers and in print.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

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
    (213, 94, 0),
    (111, 84, 190),
    (128, 150, 40),
    (0, 130, 140),
    (222, 120, 150),
    (150, 20, 40),
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


def vary_brightness(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Makes some particles slightly lighter or darker, to show how a material flows.

    Args:
        colours: (N, 3), one per particle.

    Returns:
        (N, 3); the change depends on the particle's index only, and is zero for the first.
    """
    changes = np.array([0.0, 0.16, -0.14, 0.07, -0.07])
    change = changes[(np.arange(len(colours), dtype=np.uint64) * 2654435761 >> 13) % len(changes)][:, None]
    base = colours.astype(np.float64)
    mixed = np.where(change > 0, base + (255 - base) * change, base * (1 + change))
    return np.asarray(np.round(mixed), dtype=np.uint8)


def hex_code(colour: Rgb) -> str:
    """A colour as #rrggbb, for matplotlib."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
