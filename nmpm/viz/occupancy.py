"""Where an ensemble's particles are: the share of members that occupy each cell of a grid, frame by frame."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from nmpm.colours import INTERIOR, Rgb, material_colours

LEVELS = (0.1, 0.5, 0.9)
"""Shares of members at which the bands of a picture begin."""
TINTS = (0.18, 0.35, 0.55)
"""Share of the ensemble's colour in these bands, light to dark."""
SEVERAL: Rgb = (84, 98, 122)
"""The colour of bands where there are several materials."""
CELL = 1.0
"""Side of a cell in particle spacings; with smaller ones, chance gaps in a liquid would count as empty."""


def occupied_share(
    members: Iterable[NDArray[np.floating]], low: NDArray[np.float64], cell: float, shape: tuple[int, int]
) -> NDArray[np.float64]:
    """The share of members that occupy each cell of a plane grid.

    A particle occupies its cell, half of each cell beside it, and a quarter of those at its corners; several add up to
    at most a whole cell.

    Args:
        members: Positions (N, 2) of each member; those outside of the grid, or NaN, do not count.
        low: (2,) lower corner of the grid.
        cell: Side of its square cells.
        shape: Cells along (x, y).

    Returns:
        `shape`, in [0, 1].
    """
    shares, count = np.zeros(shape), 0
    for position in members:
        place = np.floor((position[~np.isnan(position[:, 0])] - low) / cell).astype(np.int64)
        place = place[((place >= 0) & (place < shape)).all(axis=1)]
        flat = np.bincount(place[:, 0] * shape[1] + place[:, 1], minlength=shape[0] * shape[1])
        shares += np.minimum(1.0, _spread(_spread(flat.reshape(shape).astype(np.float64)).T).T)
        count += 1
    return shares / max(count, 1)


def _spread(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Adds half of each row to the rows beside it."""
    spread = values.copy()
    spread[1:] += values[:-1] / 2
    spread[:-1] += values[1:] / 2
    return spread


def ensemble_colour(materials: tuple[str, ...]) -> Rgb:
    """The colour of an ensemble's bands: that of its material where it has one alone."""
    return material_colours(materials)[materials[0]] if len(materials) == 1 else SEVERAL


def band_colours(materials: tuple[str, ...]) -> list[Rgb]:
    """The colours of the bands that begin at `LEVELS`, on a picture's background."""
    colour, background = np.array(ensemble_colour(materials)), np.array(INTERIOR)
    mixed = (np.round(background + tint * (colour - background)).astype(int).tolist() for tint in TINTS)
    return [(red, green, blue) for red, green, blue in mixed]
