"""Periodic axes: particles that leave at one end come back at the other, one period away, with the same velocity."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

_FAR = 0.5  # of the extent: longer steps are jumps
_AGREE = 0.02  # of the period
_JUMPS = 3  # fewer suffice where their period is the extent
_FULL = 0.01  # of the period: how far the extent may differ from it then
_WRAPS = 0.5  # of the long steps
_ROUNDING = 1e-4  # of the period: errors that are rounded away


@dataclass(frozen=True)
class Period:
    """The period of an axis."""

    lower: float
    length: float
    jumps: int  # that it was found from

    @property
    def interval(self) -> tuple[float, float]:
        """(lower, upper), one period apart."""
        return self.lower, self.lower + self.length


def find_period(positions: Iterable[np.ndarray], axis: int, low: np.ndarray, high: np.ndarray) -> Period | None:
    """The period along an axis, where positions (F, N, D) lie between low and high (D,); None if they do not wrap.

    Most long steps must be wraps, where the steps before and after continue one motion along all axes.
    """
    lengths = np.concatenate([np.empty(0), *(_jumps(position, axis, high - low) for position in positions)])
    wraps = np.isfinite(lengths)
    if not len(lengths) or wraps.mean() < _WRAPS:
        return None
    return _period(lengths[wraps], float(low[axis]), float(high[axis]))


def _period(lengths: np.ndarray, low: float, high: float) -> Period | None:
    length, least = float(np.median(lengths)), high - low
    close = np.abs(lengths - length) < _AGREE * length
    if close.mean() < 0.5 or (close.sum() < _JUMPS and abs(length - least) > _FULL * length):
        return None
    error = 3 * float(np.std(lengths[close])) / math.sqrt(close.sum()) + _ROUNDING * length
    length = roundest(max(length - error, least), max(length, least) + error)
    slack = _ROUNDING / 10 * length
    return Period(roundest(min(high - length, low) - slack, low + slack), length, int(close.sum()))


def _jumps(position: np.ndarray, axis: int, extent: np.ndarray) -> np.ndarray:
    """The period by each long step along an axis; NaN by steps that do not continue the motion."""
    step = np.diff(position, axis=0)
    if len(step) < 3 or not extent[axis] > 0:
        return np.empty(0)
    before, jump, after = step[:-2], step[1:-1], step[2:]
    size = [np.abs(each[..., axis]) / extent[axis] for each in (before, jump, after)]
    far = (size[1] > _FAR) & (size[0] < _FAR) & (size[2] < _FAR)
    expected = (before[far] + after[far]) / 2
    excess = jump[far] - expected
    speed = np.linalg.norm(expected, axis=1)[:, None] + 1e-3 * extent
    # Along the other axes a particle moves on, unless it wraps there too.
    smooth = np.abs(excess) < speed
    smooth |= np.abs(excess) > (1 - _FULL) * extent
    outward = np.sign(expected[:, axis]) != np.sign(jump[far][:, axis])
    return np.where(smooth.all(axis=1) & outward, np.abs(excess[:, axis]), np.nan)


def roundest(low: float, high: float) -> float:
    """The number in [low, high] with the fewest digits; of equally round ones that closest to the middle."""
    middle = (low + high) / 2
    if low <= 0 <= high or not high > low:
        return 0.0 if low <= 0 <= high else middle
    for digits in range(-12, 16):
        unit = 10.0 ** -(digits - math.ceil(math.log10(max(abs(low), abs(high)))))
        for step in (unit, unit / 2):
            value = round(middle / step) * step
            if low <= value <= high:
                return float(f"{value:.12g}")
    return middle


def unwrap(position: np.ndarray, periods: np.ndarray) -> np.ndarray:
    """(F, N, D) positions that go on where particles wrap; `periods` (D,) are 0 along axes that do not."""
    if not periods.any():
        return position
    safe = np.where(periods > 0, periods, 1.0)
    step = np.diff(position, axis=0)
    turns = np.where(periods > 0, np.round(step / safe), 0.0)
    unwrapped: np.ndarray = position.copy()
    unwrapped[1:] -= np.cumsum(np.nan_to_num(turns), axis=0) * periods
    return unwrapped
