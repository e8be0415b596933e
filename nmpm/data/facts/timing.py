"""The time between frames, from recorded times, or from velocities beside displacements."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nmpm.data.facts.fact import Fact
from nmpm.data.facts.periodic import roundest
from nmpm.data.facts.sample import Sample

_EVEN = 0.01  # of a step
_ALIKE = 0.02  # of the time step: another differs by more
_CORRELATED = 0.99  # displacements and velocities that belong together


class TimeSteps:
    """Accumulates the recorded steps in time of trajectories."""

    def __init__(self) -> None:
        self._medians: list[float] = []
        self._uneven = 0

    def add(self, time: np.ndarray | None) -> None:
        """Adds the (T,) times of the frames of a trajectory, if it has any."""
        if time is None or np.ndim(time) != 1 or len(time) < 2 or not np.isfinite(time).all():
            return
        steps = np.diff(np.asarray(time, dtype=np.float64))
        median = float(np.median(steps))
        if median > 0:
            self._medians.append(median)
            self._uneven += bool((np.abs(steps - median) > _EVEN * median).any())

    def fact(self, samples: Sequence[Sample]) -> Fact[float]:
        """The time between frames; 1, so that the frame is the unit of time, where nothing tells it."""
        by_velocity = _step_by_velocities(samples)
        per_frame = by_velocity is not None and abs(by_velocity - 1) < _ALIKE
        if not self._medians:
            if by_velocity is not None and not per_frame:
                return Fact(by_velocity, "displacements over recorded velocities.", "measured")
            how = "no times are recorded, so times are in frames, velocities in length per frame."
            return Fact(1.0, how, "likely" if per_frame else "guessed")
        step = float(np.median(self._medians))
        step = roundest(step * (1 - 1e-6), step * (1 + 1e-6))
        if by_velocity is not None and not per_frame and abs(by_velocity / step - 1) > _ALIKE:
            how = f"displacements over recorded velocities; recorded times step by {step:.6g}, in another unit."
            return Fact(by_velocity, how, "likely")
        return Fact(step, f"the median step of the recorded times, in their unit{self._notes(step)}.", "measured")

    def _notes(self, step: float) -> str:
        low, high = min(self._medians), max(self._medians)
        mixed = f"; it differs between trajectories, from {low:.4g} to {high:.4g}" if high - low > _EVEN * step else ""
        count = len(self._medians)
        uneven = f"; in {self._uneven} of {count} trajectories steps are uneven" if self._uneven else ""
        return mixed + uneven


def _step_by_velocities(samples: Sequence[Sample]) -> float | None:
    """Displacements over velocities of moving particles, or None where they do not belong together."""
    sums = np.zeros(3)  # of squares of displacements, products, squares of velocities
    for sample in samples:
        if sample.velocity is None or len(sample.position) < 3:
            continue
        move = (sample.position[2:].astype(np.float64) - sample.position[:-2]) / 2
        velocity = sample.velocity[1:-1].astype(np.float64)
        there = np.isfinite(move) & np.isfinite(velocity)
        # Jumps across periodic axes and collisions aside.
        there &= np.abs(move) <= 4 * np.median(np.abs(move[there])) if there.any() else False
        sums += [(move[there] ** 2).sum(), (move[there] * velocity[there]).sum(), (velocity[there] ** 2).sum()]
    if not sums.all() or sums[1] < _CORRELATED * math.sqrt(sums[0] * sums[2]):
        return None
    step = float(sums[1] / sums[2])
    return roundest(step * 0.998, step * 1.002)
