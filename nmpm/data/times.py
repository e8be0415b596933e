"""Times of frames: whether their steps are even, as models need them, and what is wrong with those that are not."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from nmpm._support.messages import counted
from nmpm.data.format import Trajectory
from nmpm.data.metadata import Fact
from nmpm.data.statistics import roundest
from nmpm.errors import DataError

if TYPE_CHECKING:
    from nmpm.data.samples import Sample


_TOLERANCE = 0.02  # of a step
_JITTER = 0.25  # of a step: times that are so close to even ones jitter
_DECIMALS = range(10)
_COARSE = 0.15  # of a step; differences are not put down to rounding that is coarser
_RESTART = 0.9  # of the frames are in order where a simulation was restarted


def uneven_step(time: np.ndarray) -> tuple[int, float] | None:
    """The frame after the most unusual step of (T,) times, and that step over the usual one; None if all are even.

    Steps are even that differ by less than 2%, or by no more than the rounding of the times.
    """
    steps = np.diff(np.asarray(time, dtype=np.float64))
    if not len(steps):
        return None
    mean = float(steps.mean())
    if mean > 0 and np.abs(steps - mean).max() <= max(_TOLERANCE * mean, _rounding(time, mean)):
        return None
    usual = usual_step(time) or mean or 1.0
    factors = steps / usual
    badness = np.where(factors > 0, np.abs(np.log(np.maximum(factors, 1e-300))), np.inf)
    frame = int(np.argmax(badness))
    return frame + 1, float(factors[frame])


def usual_step(time: np.ndarray) -> float:
    """The mean step of (T,) times that are even but for rounding and jitter, else the median step."""
    steps = np.diff(np.asarray(time, dtype=np.float64))
    mean = float(steps.mean())
    even = mean > 0 and np.abs(time - time[0] - mean * np.arange(len(time))).max() <= _JITTER * mean
    return mean if even and np.abs(steps - mean).max() <= _JITTER * mean else float(np.median(steps))


def recorded_step(trajectory: Trajectory) -> float | None:
    """The usual step of a trajectory's recorded times; None where none are recorded, or they do not grow."""
    time = recorded_times(trajectory)
    if time is None or len(time) < 2 or not np.isfinite(time).all():
        return None
    step = usual_step(time)
    return step if step > 0 else None


def recorded_times(trajectory: Trajectory) -> np.ndarray | None:
    """(T,) float64 recorded times of a trajectory's frames; None where there are none."""
    time = np.asarray(trajectory.fields.get("time", ()), dtype=np.float64)
    return time if time.shape == (len(trajectory.position),) else None


@dataclass(frozen=True)
class TimeFault:
    """What is wrong with the times of frames, and how to mend it."""

    sentence: str  # begins with "its"
    remedy: str  # options of `nmpm convert` or a sentence
    frame: int  # where it shows first
    factor: float  # of the step there over the usual one
    jitter: bool = False  # whether steps merely vary around their mean


def find_time_fault(time: np.ndarray) -> TimeFault | None:
    """What is wrong with (T,) times: missing, going back, repeated, uneven or jittering; None if nothing is."""
    known = np.isfinite(time)
    if not known.all():
        frame = int(np.argmin(known))
        many = counted(int((~known).sum()), "frame")
        remedy = "State the time between frames: --dt."
        return TimeFault(f"its times are missing in {many}, first in frame {frame}.", remedy, frame, 1.0)
    uneven = uneven_step(time)
    if uneven is None:
        return None
    (frame, factor), step, steps = uneven, usual_step(time), np.diff(time)
    back = np.flatnonzero(steps < 0)
    if len(back):
        frame = int(back[0]) + 1
        if time[frame] <= time[0] and len(increasing_frames(time)) < _RESTART * len(time):
            sentence = f"its times start again in frame {frame}, at {time[frame]:.4g}: it holds more than one run."
            return TimeFault(sentence, "Give each run a file, or arrays, of its own.", frame, factor)
        sentence = f"its times go back in frame {frame}, from {time[frame - 1]:.4g} to {time[frame]:.4g}: a restart?"
    elif (steps == 0).any():
        frame = int(np.argmax(steps == 0)) + 1
        many = counted(int((steps == 0).sum()), "frame")
        sentence = f"its times repeat: {many} at the time of the frame before, first frame {frame}."
    else:
        sentence = (
            f"its steps in time are uneven: frame {frame} is {factor:.3g} usual steps of {step:.4g} after the one"
            f" before; {int((np.abs(steps / step - 1) > _TOLERANCE).sum())} of {len(steps)} steps differ."
        )
        if step == steps.mean():  # they jitter
            jitter = float(np.abs(steps / step - 1).max())
            sentence = f"its steps in time jitter by up to {jitter:.1%} around their mean, {step:.6g}."
            return TimeFault(sentence, f"--resample {step:.6g}", frame, factor, jitter=True)
    return TimeFault(sentence, f"--resample {float(np.median(steps[steps > 0])):.6g}", frame, factor)


def increasing_frames(time: np.ndarray) -> np.ndarray:
    """Indices of the most frames of (T,) times that increase; of frames that exclude each other the later ones."""
    ends: list[float] = []  # negated last times of increasing sequences, read from the end, by length
    last = list[int]()
    before = np.full(len(time), -1)
    for index in range(len(time) - 1, -1, -1):
        place = bisect_left(ends, -time[index])
        before[index] = last[place - 1] if place else -1
        if place == len(ends):
            ends.append(-time[index])
            last.append(index)
        elif -time[index] < ends[place]:
            ends[place], last[place] = -time[index], index
    frames = list[int]()
    index = last[-1]
    while index >= 0:
        frames.append(index)
        index = int(before[index])
    return np.array(frames)


def take_frames(trajectory: Trajectory, frames: np.ndarray) -> Trajectory:
    """Some frames of a trajectory, with all of its particles; fields whose first axis counts frames follow."""
    count = len(trajectory.position)
    fields = {
        name: values[frames] if values.shape[:1] == (count,) else values for name, values in trajectory.fields.items()
    }
    return replace(trajectory, position=trajectory.position[frames], fields=fields)


def _rounding(time: np.ndarray, step: float) -> float:
    """How much steps of rounded times may differ from even ones; 0 where the times are not rounded to a part of one."""
    for decimals in _DECIMALS:
        unit = 10.0**-decimals
        if unit <= _COARSE * step and np.abs(time / unit - np.round(time / unit)).max() < 1e-3:
            return 1.1 * unit
    return 0.0


def check_times(time: np.ndarray | None, where: str) -> None:
    """Raises a DataError that says what is wrong with (T,) times if their steps are uneven, and the remedy."""
    if time is not None and (fault := find_time_fault(time)) is not None:
        remedy, option = fault.remedy, fault.remedy.removeprefix("--")
        if option != remedy:
            remedy = f"Models need even ones; interpolate the positions: {remedy} (fit: --data.{option})."
        raise DataError(f"{where}: {fault.sentence} {remedy}")


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
            error = _SINGLE if (time == np.float32(time)).all() else _DOUBLE
            plain = roundest(step * (1 - error), step * (1 + error))
            self._usual.append(plain if float(f"{plain:.{_DIGITS}g}") == plain else step)
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
