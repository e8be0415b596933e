"""Ends of axes without walls: periods, one of which apart particles come back, and openings, where tracks end."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

_FAR = 0.5  # of the extent: longer steps are jumps
_AGREE = 0.02  # of the period
_JUMPS = 3  # fewer suffice where their period is the extent
_FULL = 0.01  # of the period: how far the extent may differ from it then
_WRAPS = 0.5  # of the long steps
_ROUNDING = 1e-4  # of the period: errors that are rounded away
_ZONE = 0.1  # of the extent at each end: where particles that leave an axis are seen last
_GONE = 5  # frames after which an absent particle has left; another may be in its place later
_MOST = 0.6  # of the ends of tracks: if so many are in the zones of some axes, those axes explain them
_ENRICHED = 2.0  # times as many ends of tracks in the zones as positions


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


@dataclass(frozen=True)
class Openings:
    """The axes along which particles leave."""

    axes: frozenset[int]
    ends: int  # tracks that end before the last frame
    starts: int  # tracks that begin after the first one
    anywhere: bool  # whether tracks end in mid volume as well


def find_openings(positions: Sequence[np.ndarray], low: np.ndarray, high: np.ndarray) -> Openings:
    """The axes near whose ends tracks end, in positions (F, N, D) of each trajectory, NaN where absent.

    Where most tracks end elsewhere, as in a measured volume, particles come and go along all axes.
    """
    dim = len(low)
    last = np.concatenate([np.empty((0, dim)), *(_track_ends(each) for each in positions)])
    first = sum(len(_track_ends(each[::-1])) for each in positions)
    if not len(last):
        return Openings(frozenset(), 0, first, anywhere=False)
    some = np.concatenate([each[np.isfinite(each).all(axis=2)][::7] for each in positions])
    zone = _ZONE * (high - low)
    near = (last < low + zone) | (last > high - zone)
    usual = ((some < low + zone) | (some > high - zone)).mean(axis=0)
    enriched = np.flatnonzero(near.mean(axis=0) > np.maximum(_ENRICHED * usual, _ZONE))
    if near[:, enriched].any(axis=1).mean() > _MOST:
        return Openings(frozenset(enriched.tolist()), len(last), first, anywhere=False)
    return Openings(frozenset(range(dim)), len(last), first, anywhere=True)


def _track_ends(position: np.ndarray) -> np.ndarray:
    """The last positions (K, D) of particles that are then absent for five frames, or until the end."""
    present = np.isfinite(position).all(axis=2)
    ends = present[:-1].copy()
    for later in range(1, min(_GONE, len(ends)) + 1):
        ends[: len(present) - later] &= ~present[later:]
    return np.asarray(position[:-1][ends], np.float64)
