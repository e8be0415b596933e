"""Times of frames: whether their steps are even, as models need them."""

from __future__ import annotations

import numpy as np

from nmpm.data.format import Trajectory
from nmpm.errors import DataError

_TOLERANCE = 0.02  # of a step
_DECIMALS = range(10)
_COARSE = 0.15  # of a step; differences are not put down to rounding that is coarser


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
    usual = float(np.median(steps)) or mean or 1.0
    factors = steps / usual
    badness = np.where(factors > 0, np.abs(np.log(np.maximum(factors, 1e-300))), np.inf)
    frame = int(np.argmax(badness))
    return frame + 1, float(factors[frame])


def usual_step(time: np.ndarray) -> float:
    """The mean step of (T,) times where the steps are even, so that rounding does not count, else the median."""
    steps = np.diff(np.asarray(time, dtype=np.float64))
    return float(np.median(steps) if uneven_step(time) else steps.mean())


def recorded_step(trajectory: Trajectory) -> float | None:
    """The usual step of a trajectory's recorded times; None where none are recorded, or they do not grow."""
    time = np.asarray(trajectory.fields.get("time", ()), dtype=np.float64)
    if time.shape != (len(trajectory.position),) or len(time) < 2 or not np.isfinite(time).all():
        return None
    step = usual_step(time)
    return step if step > 0 else None


def _rounding(time: np.ndarray, step: float) -> float:
    """How much steps of rounded times may differ from even ones; 0 where the times are not rounded to a part of one."""
    for decimals in _DECIMALS:
        unit = 10.0**-decimals
        if unit <= _COARSE * step and np.abs(time / unit - np.round(time / unit)).max() < 1e-3:
            return 1.1 * unit
    return 0.0


def check_times(time: np.ndarray | None, where: str) -> None:
    """Raises a DataError that names the most unusual step if those of (T,) times are uneven."""
    uneven = None if time is None else uneven_step(time)
    if time is not None and uneven is not None:
        (frame, factor), usual = uneven, usual_step(time)
        raise DataError(
            f"{where}: its steps in time are uneven: frame {frame} is {factor:.3g} usual steps of {usual:.4g} after the"
            f" one before; models need even ones. Resample the positions: --resample {usual:.4g} (fit: --data.resample"
            f" {usual:.4g})."
        )
