"""Measurements of trajectories, in memory that does not grow with the dataset, and anomalies found on the way."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from nmpm.data.format import Metadata, Trajectory
from nmpm.data.grid_rule import GridFacts, grid_shape
from nmpm.data.statistics import Extent, count_gone, displacements, first_moving_particle, first_outside
from nmpm.scene import Interval

_MASK_CELLS = 64
_FRAMES_ON_GRIDS = 12
_REST = 0.02  # of a trajectory's peak speed
_JUMP = 5.0  # in spacings; a larger change between successive displacements of a particle is an anomaly
_BINS = np.geomspace(1e-9, 1e2, 1101)  # of speeds, in longest sides per frame; 2.3% wide


class Measurements:
    """Accumulates measurements of a dataset's trajectories.

    Args:
        metadata: Facts about the dataset.
        domain: The extent of the grids.
        numbers: Cells along the longest side of each grid to measure on.
    """

    def __init__(self, metadata: Metadata, domain: Sequence[Interval], numbers: Sequence[int]) -> None:
        self.metadata, self.domain = metadata, domain
        self.low, high = np.asarray(domain).T
        self.extent = high - self.low
        self.longest = float(self.extent.max())
        self.observed = Extent(metadata.dim)
        self.rests: list[int | None] = []
        self.falls: list[np.ndarray] = []
        self._counts = np.zeros(len(_BINS) + 1)
        self._fastest = 0.0
        self._per_cell: dict[int, list[float]] = {cells: [] for cells in numbers}
        self._mask = np.zeros(math.prod(self.shape(_MASK_CELLS)), bool)
        self._shares: list[float] = []

    def shape(self, cells: int) -> tuple[int, ...]:
        """Cells along each axis."""
        return grid_shape(self.domain, self.metadata.periodic, cells)

    def add(self, trajectory: Trajectory) -> None:
        """Adds a trajectory."""
        types, position = trajectory.particle_type, trajectory.position
        moving = self.metadata.is_moving(types)
        self.observed.add(position[:, moving | self.metadata.is_obstacle(types)])
        self.observed.gone += count_gone(position[:, moving], self.metadata)
        if moving.any():
            step = displacements(position[:, moving], self.metadata)
            if len(step):
                self._add_speeds(np.linalg.norm(step, axis=-1))
            if len(step) > 1:
                self.falls.append(np.median(np.diff(step[:4], axis=0), axis=(0, 1)))
            self._add_cells(position[:, moving])

    def _add_speeds(self, speed: np.ndarray) -> None:
        self._counts += np.bincount(np.digitize(speed.ravel() / self.longest, _BINS), minlength=len(self._counts))
        self._fastest = max(self._fastest, float(speed.max()))
        quick = np.quantile(speed, 0.99, axis=1)
        awake = np.flatnonzero(quick > _REST * quick.max())
        first = int(awake[-1]) + 1 if len(awake) else 0
        self.rests.append(first if first < len(speed) else None)

    def _add_cells(self, position: np.ndarray) -> None:
        for cells in self._per_cell:
            for frame in np.unique(np.linspace(0, len(position) - 1, _FRAMES_ON_GRIDS).astype(int)):
                index = self._cells(position[frame], cells)
                self._per_cell[cells].append(len(index) / len(np.unique(index)))
        occupied = np.zeros(self._mask.size, bool)
        for frame in position:
            occupied[self._cells(frame, _MASK_CELLS)] = True
        self._shares.append(float(occupied.mean()))
        self._mask |= occupied

    def _cells(self, position: np.ndarray, cells: int) -> np.ndarray:
        """Flat index of the cell that contains each of (N, D) particles, (N,)."""
        shape = np.array(self.shape(cells))
        index = np.floor((position - self.low) / self.extent * shape).astype(int)
        index = np.where(self.metadata.periodic, index % shape, np.clip(index, 0, shape - 1))
        return np.asarray(np.ravel_multi_index(tuple(index.T), tuple(shape)))

    def _speed_quantile(self, share: float) -> float:
        """A quantile of all speeds, in domain length per frame, to within 2.3%."""
        total = np.cumsum(self._counts)
        index = int(np.searchsorted(total, share * total[-1])) if total[-1] else 0
        upper = _BINS[min(index, len(_BINS) - 1)]
        return 0.0 if index == 0 else math.sqrt(_BINS[index - 1] * upper) * self.longest

    def grids(self) -> tuple[GridFacts, ...]:
        """Facts about the data on each candidate grid."""
        speeds = (self._speed_quantile(0.5), min(self._speed_quantile(0.999), self._fastest), self._fastest)
        medians = {cells: float(np.median(values)) if values else 0.0 for cells, values in self._per_cell.items()}
        return tuple(
            GridFacts(cells, self.shape(cells), per_cell, *(speed / (self.longest / cells) for speed in speeds))
            for cells, per_cell in medians.items()
        )

    def occupied(self) -> tuple[float, float]:
        """Share of the domain ever occupied, in all trajectories together and in one of them (median)."""
        return float(self._mask.mean()), float(np.median(self._shares)) if self._shares else 0.0


def find_anomalies(trajectory: Trajectory, metadata: Metadata, spacing: float, where: str) -> Iterator[str]:
    """Yields the anomalies of one trajectory, as sentences that name `where`, frame and particle.

    `spacing` is the typical distance between neighbours, in domain length.
    """
    types, position = trajectory.particle_type, trajectory.position
    moving = np.flatnonzero(metadata.is_moving(types))
    if metadata.domain is not None and (outside := first_outside(position, metadata.domain, metadata.boundary)):
        frame, particle, leaving = outside
        yield (
            f"{where}, frame {frame}: particle {particle} is outside of the stated domain, at"
            f" {position[frame, particle].round(5).tolist()}; {leaving} particles leave it."
        )
    change = np.linalg.norm(np.diff(displacements(position[:, moving], metadata), axis=0), axis=-1)
    far = change > _JUMP * spacing
    if far.any():
        frame, index = map(int, np.argwhere(far)[0])
        yield (
            f"{where}: particle {int(moving[index])} jumps by {change[frame, index]:.3g} between frames {frame + 1} and"
            f" {frame + 2}, {change[frame, index] / spacing:.0f} times the distance of neighbours"
            f" ({int(far.any(axis=0).sum())} particles jump)."
        )
    _, first, number = np.unique(position[0, moving], axis=0, return_index=True, return_counts=True)
    if (number > 1).any():
        twin = int(moving[first[int(np.argmax(number))]])
        twins = int((number - 1).sum())
        yield f"{where}, frame 0: {twins} particles have the position of another, e.g. of particle {twin}."
    mover = first_moving_particle(position, metadata.is_static(types), metadata.bounds)
    if mover is not None:
        yield f"{where}: particle {mover}, of the static type {types[mover]}, moves."
