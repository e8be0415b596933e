"""Measurements of trajectories, in memory that does not grow with the dataset."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nmpm.data.format import Metadata, Trajectory
from nmpm.data.grid_rule import GridFacts, grid_shape
from nmpm.data.statistics import Extent, displacements, without_those_gone
from nmpm.scene import Interval

_MASK_CELLS = 64
_FRAMES_ON_GRIDS = 12
_FAR = 2**40  # cells: overflowed positions are no integers
_REST = 0.02  # of a trajectory's peak speed
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
        position = without_those_gone(position[:, moving], self.metadata)
        if np.isfinite(position).any():
            step = displacements(position, self.metadata)
            speed = np.linalg.norm(step, axis=-1)
            if np.isfinite(speed).any():
                self._add_speeds(speed)
            if np.isfinite(acceleration := np.diff(step[:4], axis=0)).any():
                self.falls.append(np.nanmedian(acceleration, axis=(0, 1)))
            self._add_cells(position)

    def _add_speeds(self, speed: np.ndarray) -> None:
        there = np.isfinite(speed)
        self._counts += np.bincount(np.digitize(speed[there] / self.longest, _BINS), minlength=len(self._counts))
        self._fastest = max(self._fastest, float(speed[there].max()))
        quick = np.quantile(np.where(there, speed, 0.0), 0.99, axis=1)
        awake = np.flatnonzero(quick > _REST * quick.max())
        first = int(awake[-1]) + 1 if len(awake) else 0
        self.rests.append(first if first < len(speed) else None)

    def _add_cells(self, position: np.ndarray) -> None:
        for cells in self._per_cell:
            for frame in np.unique(np.linspace(0, len(position) - 1, _FRAMES_ON_GRIDS).astype(int)):
                if len(index := self._cells(position[frame], cells)):
                    self._per_cell[cells].append(len(index) / len(np.unique(index)))
        occupied = np.zeros(self._mask.size, bool)
        for frame in position:
            occupied[self._cells(frame, _MASK_CELLS)] = True
        self._shares.append(float(occupied.mean()))
        self._mask |= occupied

    def _cells(self, position: np.ndarray, cells: int) -> np.ndarray:
        """Flat index of the cell that contains each of (N, D) particles that are there, (N',)."""
        shape = np.array(self.shape(cells))
        position = position[~np.isnan(position[:, 0])]
        index = np.clip(np.floor((position - self.low) / self.extent * shape), -_FAR, _FAR).astype(int)
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
