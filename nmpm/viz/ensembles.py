"""Ensembles in pictures: the share of members at each place, and quantities of all particles along the frames.

Front, mean height and kinetic energy are as in `nmpm.metrics.quantities`, without torch and for all frames at once; the
particles have one volume.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nmpm.colours import INTERIOR, Rgb, material_colours
from nmpm.viz.camera import box_corners
from nmpm.viz.trajectories import Floats, LabelledTrajectories

LEVELS = (0.1, 0.5, 0.9)
"""Shares of members at which the bands of a picture begin."""
TINTS = (0.18, 0.35, 0.55)
"""Share of the ensemble's colour in these bands, light to dark."""
SEVERAL: Rgb = (84, 98, 122)
"""The colour of bands where there are several materials."""
CELL = 1.0
"""Side of a cell in particle spacings; with smaller ones, chance gaps in a liquid would count as empty."""
FRONT = 0.95
"""Share of the particles that is behind the front."""
BANDS = (0.5, 0.9)
"""Shares of the members that the bands of a chart contain."""
Curve = NDArray[np.float64]


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


@dataclass(frozen=True, eq=False)
class QuantityCurves:
    """A quantity along the frames, of each member of an ensemble and of its truth.

    Args:
        name: In words, with the unit.
        members: (M, T).
        truth: (T,); None without a truth.
    """

    name: str
    members: Curve
    truth: Curve | None

    def bands(self) -> dict[float, Curve]:
        """Lower and upper end (2, T) of the interval that contains a share of the members, for each of `BANDS`."""
        return {
            share: np.quantile(self.members, [(1 - share) / 2, (1 + share) / 2], axis=0) for share in reversed(BANDS)
        }


def quantity_curves(trajectories: LabelledTrajectories) -> list[QuantityCurves]:
    """Mean height (with gravity), front and kinetic energy of an ensemble's members; their errors where truth is."""
    members, truth = list(trajectories.members.values()), trajectories.truth
    quantities = {
        **({"mean height (length)": mean_height} if _down(trajectories).any() else {}),
        "front (length)": front,
        "kinetic energy (length²/s²)": kinetic_energy,
    }
    curves = [
        QuantityCurves(
            name,
            np.stack([measure(trajectories, member) for member in members]),
            None if truth is None else measure(trajectories, truth),
        )
        for name, measure in quantities.items()
    ]
    if truth is None:
        return curves
    errors = np.stack([trajectories.rms_distance(truth, member) for member in members])
    return [*curves, QuantityCurves("RMS position error (length)", errors, None)]


def mean_height(trajectories: LabelledTrajectories, position: Floats) -> Curve:
    """Mean height (T,) above the lowest bound against gravity, of positions (T, N, D); 0 where no particle is."""
    up = -_down(trajectories)
    heights = trajectories.wrap(position[:, trajectories.predicted]) @ up
    return _mean(heights - (box_corners(trajectories.bounds) @ up).min(), np.ones(heights.shape[1]))


def front(trajectories: LabelledTrajectories, position: Floats) -> Curve:
    """How far the particles have advanced, (T,): the distance across gravity that 95% of them are within.

    It counts from their mean position in the first frame with particles, in all directions without gravity; 0 where
    no particle is.
    """
    position, down = position[:, trajectories.predicted], _down(trajectories)
    there = ~np.isnan(position[..., 0])
    start = int(there.any(axis=1).argmax())
    offset = position - position[start, there[start]].astype(np.float64).mean(axis=0)
    for axis in range(trajectories.dim):
        offset[..., axis] = trajectories.shortest(offset[..., axis], axis)
    offset -= (offset @ down)[..., None] * down
    distance = np.sort(np.sqrt(np.square(offset).sum(axis=-1)), axis=1)  # (NaN comes last)
    index = np.maximum(np.ceil(FRONT * there.sum(axis=1) - 1e-9).astype(int) - 1, 0)
    return np.where(there.any(axis=1), distance[np.arange(len(distance)), index], 0.0)


def kinetic_energy(trajectories: LabelledTrajectories, position: Floats) -> Curve:
    """Kinetic energy per mass (T,), in length² per second², of the motion from the frame before.

    The first frame has that of the second; 0 where no particle is.
    """
    moving = trajectories.predicted
    squares = np.zeros((max(len(position) - 1, 0), int(moving.sum())))
    for axis in range(trajectories.dim):
        step = np.diff(position[:, moving, axis].astype(np.float64), axis=0)
        squares += np.square(trajectories.shortest(step, axis))
    mass = np.array([trajectories.densities.get(name, 1.0) for name in trajectories.material[moving].tolist()])
    energy = _mean(squares, mass) / (2 * trajectories.dt**2)
    return np.concatenate([energy[:1] if len(energy) else np.zeros(1), energy])


def _down(trajectories: LabelledTrajectories) -> NDArray[np.float64]:
    """(D,) unit vector along gravity; zero where gravity is, or is not known."""
    gravity = np.array(trajectories.gravity or np.zeros(trajectories.dim), dtype=np.float64)
    return gravity / (float(np.linalg.norm(gravity)) or 1.0)


def _mean(values: NDArray[np.float64], weight: NDArray[np.float64]) -> Curve:
    """Weighted means (T,) over the particles that are there of values (T, N); 0 where none is."""
    there = ~np.isnan(values)
    return np.asarray((np.where(there, values, 0.0) @ weight) / np.maximum(there @ weight, 1e-300))
