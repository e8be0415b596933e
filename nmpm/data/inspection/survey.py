"""Accumulates an inspection's measurements over trajectories, in memory that does not grow with the dataset."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nmpm.data.format import Metadata, Trajectory
from nmpm.data.inspection.anomalies import displacements
from nmpm.data.inspection.facts import GridFacts
from nmpm.scene import Interval

CANDIDATES = (16, 32, 64, 128, 256, 512)
"""Cells along the longest side: powers of two, as networks that halve the grid need."""

PER_CELL = 2.0
"""Particles per occupied cell that a grid should have. The paper's grids have 1.3 to 3: 64 cells for its MPM scenes,
128 for WBC-SPH. Its goop, at 3, is worse on 32 cells and on 128 (MSE 5.5, 2.4 and 7.1 ×10⁻³ for 32, 64 and 128)."""

_MASK_CELLS = 64
_FRAMES_ON_GRIDS = 12
_REST = 0.02  # of a trajectory's peak speed
_BINS = np.geomspace(1e-9, 1e2, 1101)  # of speeds, in longest sides per frame; 2.3% wide


class Survey:
    """Accumulates measurements; call `add` for each trajectory.

    Args:
        metadata: Of the dataset.
        domain: Extent of the grids, (lower, upper) per axis.
    """

    def __init__(self, metadata: Metadata, domain: Sequence[Interval]) -> None:
        self.metadata = metadata
        self.low, high = np.asarray(domain).T
        self.extent = high - self.low
        self.longest = float(self.extent.max())
        self.observed = np.array([np.full(metadata.dim, np.inf), np.full(metadata.dim, -np.inf)])
        self.rests: list[int | None] = []
        self.falls: list[np.ndarray] = []
        self._counts = np.zeros(len(_BINS) + 1)
        self._fastest = 0.0
        self._per_cell: dict[int, list[float]] = {cells: [] for cells in CANDIDATES}
        self._mask = np.zeros(self.shape(_MASK_CELLS), bool)
        self._shares: list[float] = []

    def shape(self, cells: int) -> tuple[int, ...]:
        """Cells along each axis, as close to square as possible."""
        return tuple(max(1, round(cells * side / self.longest)) for side in self.extent.tolist())

    def add(self, trajectory: Trajectory) -> None:
        """Adds a trajectory."""
        types, position = trajectory.particle_type, trajectory.position
        moving = np.isin(types, self.metadata.moving_types)
        present = moving | np.isin(types, list(self.metadata.static_types))
        if not present.any():
            return
        self.observed[0] = np.minimum(self.observed[0], position[:, present].min(axis=(0, 1)))
        self.observed[1] = np.maximum(self.observed[1], position[:, present].max(axis=(0, 1)))
        if not moving.any():
            return
        step = displacements(position[:, moving], self.metadata)
        speed = np.linalg.norm(step, axis=-1)
        self._add_speeds(speed)
        if len(step) > 1:
            self.falls.append(np.median(np.diff(step[:4], axis=0), axis=(0, 1)))
        self._add_cells(position[:, moving])

    def _add_speeds(self, speed: np.ndarray) -> None:
        if not len(speed):
            return
        self._counts += np.bincount(np.digitize(speed.ravel() / self.longest, _BINS), minlength=len(self._counts))
        self._fastest = max(self._fastest, float(speed.max()))
        quick = np.quantile(speed, 0.99, axis=1)
        awake = np.flatnonzero(quick > _REST * quick.max())
        first = int(awake[-1]) + 1 if len(awake) else 0
        self.rests.append(first if first < len(speed) else None)

    def _add_cells(self, position: np.ndarray) -> None:
        chosen = np.unique(np.linspace(0, len(position) - 1, _FRAMES_ON_GRIDS).astype(int))
        for cells in CANDIDATES:
            for frame in chosen:
                index = self._cells(position[frame], cells)
                self._per_cell[cells].append(len(index) / len(np.unique(index)))
        occupied_cells = np.zeros(self._mask.size, bool)
        for frame in position:
            occupied_cells[self._cells(frame, _MASK_CELLS)] = True
        self._shares.append(float(occupied_cells.mean()))
        self._mask |= occupied_cells.reshape(self._mask.shape)

    def _cells(self, position: np.ndarray, cells: int) -> np.ndarray:
        """Flat index of the cell that contains each of (N, D) particles, (N,)."""
        shape = np.array(self.shape(cells))
        place = np.floor((position - self.low) / self.extent * shape).astype(int)
        place = np.where(self.metadata.periodic, place % shape, np.clip(place, 0, shape - 1))
        return np.asarray(np.ravel_multi_index(tuple(place.T), tuple(shape)))

    def speed_quantile(self, share: float) -> float:
        """A quantile of all speeds, in domain length per frame, to within 2.3%."""
        total = np.cumsum(self._counts)
        if not total[-1]:
            return 0.0
        place = int(np.searchsorted(total, share * total[-1]))
        return (
            0.0 if place == 0 else float(math.sqrt(_BINS[place - 1] * _BINS[min(place, len(_BINS) - 1)]) * self.longest)
        )

    def grids(self) -> tuple[GridFacts, ...]:
        """Facts about the data on each candidate grid."""
        found = []
        for cells in CANDIDATES:
            size = self.longest / cells
            speeds = (self.speed_quantile(0.5), min(self.speed_quantile(0.999), self._fastest), self._fastest)
            per_cell = float(np.median(self._per_cell[cells])) if self._per_cell[cells] else 0.0
            found.append(GridFacts(cells, self.shape(cells), per_cell, *(speed / size for speed in speeds)))
        return tuple(found)

    def recommended(self) -> int:
        """The candidate whose particles per occupied cell are closest to `PER_CELL`, by ratio."""
        ratios = {grid.cells: abs(math.log(grid.per_cell / PER_CELL)) for grid in self.grids() if grid.per_cell > 0}
        return min(ratios, key=lambda cells: ratios[cells]) if ratios else CANDIDATES[0]

    def occupied(self) -> tuple[float, float]:
        """Share of the domain ever occupied, in all trajectories together and in one of them (median)."""
        return float(self._mask.mean()), float(np.median(self._shares)) if self._shares else 0.0
