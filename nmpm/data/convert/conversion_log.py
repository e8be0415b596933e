"""Facts that are collected about trajectories while they are converted, and notes on inconsistencies."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nmpm.data.convert.base import UNKNOWN_LENGTH
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.statistics import STATISTICS_KEYS, MotionStatistics, find_disagreements, first_moving_particle
from nmpm.errors import DataError

STATED = "stated_statistics"
MOVING_BOUNDARIES = "moving_boundaries"


@dataclass
class ConversionLog:
    """Collects facts about the trajectories of a conversion.

    Args:
        metadata: As the files state it.
        statistics: Of the trajectories that were added before `statistics_done` was set.
        statistics_done: Set after the first split.
        moving_boundaries: Trajectories in which a static particle moves.
        number: Trajectories.
        lower, upper: Extent of all positions, (D,).
        frames: Different numbers of frames.
        particles: Largest number of particles.
    """

    metadata: Metadata
    statistics: MotionStatistics
    statistics_done: bool = False
    moving_boundaries: int = 0
    number: int = 0
    lower: np.ndarray | None = None
    upper: np.ndarray | None = None
    frames: frozenset[int] = frozenset()
    particles: int = 0

    def add(self, trajectory: Trajectory, where: str) -> None:
        """Adds a trajectory.

        Raises:
            DataError: if its number of axes differs from the metadata, or a type is unknown.
        """
        types, position = trajectory.particle_type, trajectory.position
        if position.shape[2] != self.metadata.dim:
            raise DataError(
                f"{where}: positions have {position.shape[2]} axes, the metadata has dim = {self.metadata.dim}."
            )
        self.metadata.check_types(types, where)
        if not self.statistics_done:
            self.statistics.add(trajectory)
        self.number += 1
        static = np.isin(types, list(self.metadata.static_types))
        self.moving_boundaries += first_moving_particle(position, static, self.metadata.bounds) is not None
        present = np.isin(types, [*self.metadata.moving_types, *self.metadata.static_types])
        if present.any():
            low, high = position[:, present].min(axis=(0, 1)), position[:, present].max(axis=(0, 1))
            self.lower = low if self.lower is None else np.minimum(self.lower, low)
            self.upper = high if self.upper is None else np.maximum(self.upper, high)
        self.frames |= {len(position)}
        self.particles = max(self.particles, position.shape[1])

    def final_metadata(self) -> tuple[Metadata, list[str]]:
        """The metadata with the measured statistics, and notes on inconsistencies."""
        extra, measured = dict(self.metadata.extra), self.statistics.result()
        stated = {key: extra[key] for key in STATISTICS_KEYS if key in extra}
        notes = find_disagreements(measured, stated)
        if notes:
            notes.append(f"The stated values are kept as {STATED!r}.")
        if stated:
            extra[STATED] = stated
        extra |= measured | {"num_particles_max": self.particles}
        if self.moving_boundaries:
            extra[MOVING_BOUNDARIES] = True
            notes.append(
                f"Particles of a static type move in {self.moving_boundaries} of {self.number} trajectories. Their"
                " positions are kept; to train on them, state which types are static (--static)."
            )
        length = self.metadata.sequence_length or max(self.frames, default=2) - 1
        return replace(self.metadata, extra=extra, sequence_length=length), notes + self._lengths()

    def out_of_bounds_notes(self) -> list[str]:
        """Notes on positions outside of the stated bounds."""
        if self.lower is None or self.upper is None:
            return []
        stated_low, stated_high = np.asarray(self.metadata.bounds).T
        walls = ~np.asarray(self.metadata.periodic)
        beyond = ((self.lower < stated_low) | (self.upper > stated_high)) & walls
        return [
            f"Along {'xyz'[axis]} positions reach from {self.lower[axis]:.4g} to {self.upper[axis]:.4g}, beyond the"
            f" stated bounds {list(self.metadata.bounds[axis])}; the scene's domain will contain them."
            for axis in np.flatnonzero(beyond)
        ]

    def _lengths(self) -> list[str]:
        stated = self.metadata.sequence_length
        if stated == UNKNOWN_LENGTH or self.frames <= {stated, stated + 1}:
            return []
        few, many = min(self.frames), max(self.frames)
        lengths = f"{few}" if few == many else f"{few} to {many}"
        return [f"The metadata state sequence_length {stated}; trajectories have {lengths} frames."]
