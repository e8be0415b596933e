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
_SINGLE, _DOUBLE = 1e-6, 1e-9  # of recorded steps: errors of times in float32, and in float64 or text
_DIGITS = 6  # of a plain number


class TimeSteps:
    """Accumulates the recorded steps in time of trajectories."""

    def __init__(self) -> None:
        self._usual: list[float] = []
        self._uneven = 0

    def add(self, trajectory: Trajectory) -> None:
        """Adds a trajectory, whose times may be recorded."""
        if (step := recorded_step(trajectory)) is not None:
            time = trajectory.fields["time"]
            self._usual.append(exact_step(step, _SINGLE if (time == np.float32(time)).all() else _DOUBLE))
            self._uneven += uneven_step(time) is not None

    @property
    def usual(self) -> float | None:
        """The median of the trajectories' usual steps; None where no times are recorded."""
        return float(np.median(self._usual)) if self._usual else None

    def fact(self, samples: Sequence[Sample], steps: bool = False) -> Fact[float]:
        """The time between frames; 1, so that the frame is the unit of time, where nothing tells it.

        Recorded times state it, whatever velocities say. Where times are numbers of `steps`, whose length is not
        known, velocities tell the length.
        """
        by_velocity = step_by_velocities(samples)
        per_frame = by_velocity is not None and abs(by_velocity - 1) < _ALIKE
        if (step := self.usual) is not None and (by_velocity is None or not steps):
            unit = "numbers of steps, so that a step is the unit of time" if steps else "times, in their unit"
            return Fact(step, f"the usual step of the recorded {unit}{self._notes(step)}.", "measured")
        if by_velocity is None:
            return Fact(1.0, "no times are recorded, so the unit of time is the frame.", "guessed")
        if per_frame:
            return Fact(1.0, "displacements between frames equal the recorded velocities.", "measured")
        return Fact(by_velocity, "displacements over recorded velocities.", "measured")

    def _notes(self, step: float) -> str:
        low, high = min(self._usual), max(self._usual)
        mixed = f"; it differs between trajectories, from {low:.4g} to {high:.4g}" if high - low > _EVEN * step else ""
        count = len(self._usual)
        uneven = f"; in {self._uneven} of {count} trajectories steps are uneven" if self._uneven else ""
        return mixed + uneven


def exact_step(step: float, error: float) -> float:
    """A step, or a number with few digits that differs from it by no more than an error, a part of it."""
    plain = roundest(step * (1 - error), step * (1 + error))
    return plain if float(f"{plain:.{_DIGITS}g}") == plain else step


def step_by_velocities(samples: Sequence[Sample]) -> float | None:
    """Displacements over velocities of moving particles, their median; None where they do not belong together.

    Velocities are those of the steps before the frames, after them, or the mean of both, whichever fits best.
    """
    steps: list[tuple[float, float]] = []
    for before, after in ((True, False), (False, True), (True, True)):
        ratios = np.concatenate([np.empty(0), *(_ratios(sample, before, after) for sample in samples)])
        if len(ratios) >= _RATIOS and (step := float(np.median(ratios))) > 0:
            steps.append((float(np.median(np.abs(ratios - step))) / step, step))
    # Collisions within a step, and jumps across periodic axes, leave at least half of the ratios alone.
    scatter, step = min(steps, default=(np.inf, 0.0))
    return roundest(step * (1 - _ROUNDED), step * (1 + _ROUNDED)) if scatter <= _ALIKE else None


def _ratios(sample: Sample, before: bool, after: bool) -> np.ndarray:
    """Displacements along the velocity over the velocity, of particles faster than the median, at inner frames."""
    if sample.velocity is None or len(sample.position) < 3:
        return np.empty(0)
    position = sample.position.astype(np.float64)
    first, last = position[:-2] if before else position[1:-1], position[2:] if after else position[1:-1]
    move, velocity = (last - first) / (before + after), sample.velocity[1:-1].astype(np.float64)
    square, along = (velocity**2).sum(axis=2), (velocity * move).sum(axis=2)
    there = np.isfinite(along) & (square > 0)
    if not there.any():
        return np.empty(0)
    there &= square >= np.median(square[there])
    return np.asarray(along[there] / square[there])
