"""Open axes: particles leave or enter the volume that is seen, so that tracks begin and end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_ZONE = 0.1  # of the extent at each end: where particles that leave an axis are seen last
_GONE = 5  # frames after which an absent particle has left; another may be in its place later
_MOST = 0.6  # of the ends of tracks: if so many are in the zones of some axes, those axes explain them
_ENRICHED = 2.0  # times as many ends of tracks in the zones as positions


@dataclass(frozen=True)
class Openings:
    """The axes along which particles leave."""

    axes: frozenset[int]
    ends: int  # tracks that end before the last frame
    starts: int  # tracks that begin after the first one
    anywhere: bool  # whether tracks end in mid volume as well


def find_openings(positions: Sequence[np.ndarray], low: np.ndarray, high: np.ndarray) -> Openings:
    """The axes along which particles leave, in positions (F, N, D) of each trajectory, NaN where absent.

    A track that ends near an end of an axis left there; where most tracks end elsewhere, as in a measured volume,
    particles come and go along all axes.
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
