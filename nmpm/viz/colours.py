"""Which colour stands for which material, and the greys around them.

Materials differ in lightness as well as in hue, so that they stay apart for colour-blind readers and in print.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

Rgb = tuple[int, int, int]

PAGE: Rgb = (255, 255, 255)
INTERIOR: Rgb = (247, 247, 247)
WALL: Rgb = (205, 209, 215)
EDGE: Rgb = (168, 174, 183)
INK: Rgb = (38, 42, 48)
FAINT_INK: Rgb = (118, 124, 133)
OBSTACLE: Rgb = (132, 138, 147)

MATERIALS: Mapping[str, Rgb] = MappingProxyType(
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

SPARE: tuple[Rgb, ...] = (
    (213, 94, 0),
    (111, 84, 190),
    (128, 150, 40),
    (0, 130, 140),
    (222, 120, 150),
    (150, 20, 40),
)
"""For materials without a colour of their own."""


def colour(name: str) -> Rgb:
    """The colour of a material; one that is not known gets a spare colour, the same in every scene and every run."""
    return MATERIALS.get(name) or SPARE[_spare_index(name)]


def palette(names: Iterable[str]) -> dict[str, Rgb]:
    """A colour for each material of one scene, in the order given.

    As `colour`, but unknown materials that would share a spare colour are moved apart while spare colours last.
    """
    ordered = list(dict.fromkeys(names))
    chosen = {name: MATERIALS[name] for name in ordered if name in MATERIALS}
    for name in sorted(set(ordered) - set(chosen)):
        start = _spare_index(name)
        probes = [SPARE[(start + step) % len(SPARE)] for step in range(len(SPARE))]
        chosen[name] = next((spare for spare in probes if spare not in chosen.values()), probes[0])
    return {name: chosen[name] for name in ordered}


def shaded(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The same colours with a little light and dark from particle to particle, which shows how a material flows.

    Args:
        colours: (N, 3) one colour per particle.

    Returns:
        (N, 3); a particle's tone depends on its index alone, and the first particle's is unchanged.
    """
    tones = np.array([0.0, 0.16, -0.14, 0.07, -0.07])
    tone = tones[(np.arange(len(colours), dtype=np.uint64) * 2654435761 >> 13) % len(tones)][:, None]
    base = colours.astype(np.float64)
    mixed = np.where(tone > 0, base + (255 - base) * tone, base * (1 + tone))
    return np.asarray(np.round(mixed), dtype=np.uint8)


def css(ink: Rgb) -> str:
    """A colour as matplotlib and browsers write it."""
    return "#{:02x}{:02x}{:02x}".format(*ink)


def _spare_index(name: str) -> int:
    return zlib.crc32(name.encode()) % len(SPARE)
