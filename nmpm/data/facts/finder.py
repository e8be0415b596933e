"""Collects facts about a dataset while its trajectories pass."""

from __future__ import annotations

import numpy as np

from nmpm.data.facts.fact import Fact, Facts
from nmpm.data.format import Split, Trajectory
from nmpm.errors import DataError
from nmpm.scene import Boundary

_SAMPLE_BYTES = 2**27
_MARGIN = 0.01  # of the extent


class FactFinder:
    """Finds the facts about a dataset in its trajectories.

    Args:
        dim: Number of space dimensions.
    """

    def __init__(self, dim: int) -> None:
        self.dim = dim
        self._lower, self._upper = np.full(dim, np.inf), np.full(dim, -np.inf)
        self._types: set[int] = set()
        self._frames = 0
        self._steps: list[float] = []

    def add(self, trajectory: Trajectory) -> None:
        """Adds a trajectory."""
        position = trajectory.position.reshape(-1, self.dim)
        position = position[np.isfinite(position).all(axis=1)]
        if len(position):
            self._lower = np.minimum(self._lower, position.min(0))
            self._upper = np.maximum(self._upper, position.max(0))
        self._types.update(np.unique(trajectory.particle_type).tolist())
        self._frames = max(self._frames, len(trajectory.position))
        time = trajectory.fields.get("time")
        if time is not None and len(time) > 1:
            self._steps.append(float(np.median(np.diff(time))))

    def facts(self) -> Facts:
        """The facts; raises a DataError if no particle was ever there."""
        if not np.isfinite(self._lower).all():
            raise DataError("no trajectory has a particle, so nothing can be found about them.")
        size = float((self._upper - self._lower).max()) or 1.0
        wall: Boundary = "wall"
        bounds = tuple(
            (float(low) - _MARGIN * size, float(high) + _MARGIN * size)
            for low, high in zip(self._lower, self._upper, strict=True)
        )
        return Facts(
            bounds=Fact(bounds, "the extent of the positions and a margin of 1%.", "guessed"),
            boundary=Fact((wall,) * self.dim, "nothing else was looked for.", "guessed"),
            dt=self._dt(),
            gravity=Fact(None, "not looked for.", "guessed"),
            particle_types=Fact(name_types(self._types), "by their ids.", "guessed"),
            static_types=Fact(frozenset(), "not looked for.", "guessed"),
            prescribed_types=Fact(frozenset(), "not looked for.", "guessed"),
            particle_volume=Fact(None, "not looked for.", "guessed"),
            sequence_length=Fact(self._frames - 1, f"trajectories have up to {self._frames} frames.", "measured"),
        )

    def _dt(self) -> Fact[float]:
        if self._steps:
            return Fact(float(np.median(self._steps)), "the median step of the recorded times.", "measured")
        return Fact(1.0, "no times are recorded, so the unit of time is the frame.", "guessed")


def name_types(types: set[int]) -> dict[int, str]:
    """Names of type ids: `particles` if there is one, else `type1`, `type2`, … by their ids."""
    return {i: "particles" if len(types) == 1 else f"type{i}" for i in sorted(types)}


def find_facts(split: Split) -> Facts:
    """The facts in up to 128 MiB of positions of a split, in evenly spaced trajectories.

    Raises:
        DataError: if a trajectory cannot be read, or no particle is ever there.
    """
    finder = FactFinder(split.dim)
    for index in split.sample(_SAMPLE_BYTES):
        finder.add(split.read_with_fields(index))
    return finder.facts()
