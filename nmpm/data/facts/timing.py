"""The time between frames, from recorded times, or from velocities beside displacements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nmpm.data.facts.fact import Fact
from nmpm.data.facts.open_ends import roundest
from nmpm.data.facts.sample import Sample
from nmpm.data.format import Trajectory
from nmpm.data.times import recorded_step, uneven_step

_EVEN = 0.01  # of a step
_ALIKE = 0.02  # of the time step: another differs by more
_RATIOS = 20  # displacements over velocities
_ROUNDED = 1e-3  # of the time step


class TimeSteps:
    """Accumulates the recorded steps in time of trajectories."""

    def __init__(self) -> None:
        self._usual: list[float] = []
        self._uneven = 0

    def add(self, trajectory: Trajectory) -> None:
        """Adds a trajectory, whose times may be recorded."""
        if (step := recorded_step(trajectory)) is not None:
            self._usual.append(step)
            self._uneven += uneven_step(trajectory.fields["time"]) is not None

    def fact(self, samples: Sequence[Sample]) -> Fact[float]:
        """The time between frames; 1, so that the frame is the unit of time, where nothing tells it."""
        by_velocity = _step_by_velocities(samples)
        per_frame = by_velocity is not None and abs(by_velocity - 1) < _ALIKE
        if not self._usual and by_velocity is None:
            return Fact(1.0, "no times are recorded, so the unit of time is the frame.", "guessed")
        if not self._usual and per_frame:
            return Fact(1.0, "displacements between frames equal the recorded velocities.", "measured")
        if not self._usual and by_velocity is not None:
            return Fact(by_velocity, "displacements over recorded velocities.", "measured")
        step = float(np.median(self._usual))
        step = roundest(step * (1 - 1e-6), step * (1 + 1e-6))
        if by_velocity is not None and not per_frame and abs(by_velocity / step - 1) > _ALIKE:
            how = f"displacements over recorded velocities; recorded times step by {step:.6g}, in another unit."
            return Fact(by_velocity, how, "likely")
        return Fact(step, f"the usual step of the recorded times, in their unit{self._notes(step)}.", "measured")

    def _notes(self, step: float) -> str:
        low, high = min(self._usual), max(self._usual)
        mixed = f"; it differs between trajectories, from {low:.4g} to {high:.4g}" if high - low > _EVEN * step else ""
        count = len(self._usual)
        uneven = f"; in {self._uneven} of {count} trajectories steps are uneven" if self._uneven else ""
        return mixed + uneven


def _step_by_velocities(samples: Sequence[Sample]) -> float | None:
    """Displacements over velocities of moving particles, their median; None where they do not belong together."""
    ratios = np.concatenate([np.empty(0), *(_ratios(sample) for sample in samples)])
    if len(ratios) < _RATIOS:
        return None
    step = float(np.median(ratios))
    # Collisions within a step, and jumps across periodic axes, leave at least half of the ratios alone.
    if not step > 0 or float(np.median(np.abs(ratios - step))) > _ALIKE * step:
        return None
    return roundest(step * (1 - _ROUNDED), step * (1 + _ROUNDED))


def _ratios(sample: Sample) -> np.ndarray:
    """Displacements along the velocity over the velocity, of particles faster than the median, at inner frames."""
    if sample.velocity is None or len(sample.position) < 3:
        return np.empty(0)
    move = (sample.position[2:].astype(np.float64) - sample.position[:-2]) / 2
    velocity = sample.velocity[1:-1].astype(np.float64)
    square, along = (velocity**2).sum(axis=2), (velocity * move).sum(axis=2)
    there = np.isfinite(along) & (square > 0)
    if not there.any():
        return np.empty(0)
    there &= square >= np.median(square[there])
    return np.asarray(along[there] / square[there])
