"""Which particles of a trajectory are there in which frames, and finite values for those that are not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nmpm.errors import DataError


@dataclass(frozen=True)
class Presence:
    """The presence of a trajectory's particles, of N of which N' are there in some frame.

    Args:
        ever: (N,) whether each particle is there in any frame.
        present: (T, N') whether each of those is there in each frame.
    """

    ever: np.ndarray
    present: np.ndarray

    @classmethod
    def of(cls, position: np.ndarray) -> Presence | None:
        """The presence of particles from their (T, N, D) positions; None where all always are."""
        absent = np.isnan(position[..., 0])
        if not absent.any():
            return None
        ever = ~absent.all(axis=0)
        return cls(ever, ~absent[:, ever])

    def check(self, where: str) -> None:
        """Raises a DataError if no particle is there in two successive frames, so that none has a velocity."""
        if len(self.present) > 1 and not (self.present[1:] & self.present[:-1]).any():
            raise DataError(f"{where}: no particle is there in two successive frames. Remove the trajectory.")

    def fill(self, values: np.ndarray) -> np.ndarray:
        """(T, N', …) values, those of absent particles replaced by those they had last, or else will have first."""
        frames = np.where(self.present, np.arange(len(values))[:, None], -1)
        last = np.maximum.accumulate(frames, axis=0)
        source = np.where(last < 0, self.present.argmax(axis=0), last)
        return np.asarray(values[source, np.arange(values.shape[1])])


def obstacle_frames(position: np.ndarray, moving: bool) -> np.ndarray:
    """(T, M', D) positions of those of (T, M, D) obstacles that are ever there; where one is absent, it is as last.

    Of one frame, T = 1, where obstacles do not move.
    """
    if not moving and not np.isnan(position[0]).any():
        return position[:1]
    presence = Presence.of(position)
    return position if presence is None else presence.fill(position[:, presence.ever])


def find_tracks(present: np.ndarray, ids: np.ndarray | None = None) -> np.ndarray:
    """(K, 3) tracks: the column that holds the particle, and the first and the last frame in which it is there.

    Args:
        present: (T, N) whether the particle of each column is there in each frame.
        ids: (T, N) which particle that is, where columns hold several, one after the other; else each holds one.
    """
    column, frame = np.nonzero(present.T)
    other = np.diff(column, prepend=-1) != 0
    if ids is not None:
        other |= np.diff(ids[frame, column], prepend=0) != 0
    begins = np.flatnonzero(other)
    ends = np.append(begins[1:], len(frame)) - 1
    return np.stack([column[begins], frame[begins], frame[ends]], axis=1)


def first_frames(present: np.ndarray, length: int, every: int = 1) -> np.ndarray:
    """The first frame, for each of the windows of `length` frames, of the next window that has a velocity at its start.

    That is, of the next in whose first two frames some particle is there, or else of the last such window.

    Args:
        present: (T, N) whether each particle is there in each frame.
        length: Frames of a window.
        every: Frames from the window's first to its second.
    """
    windows = len(present) - length + 1
    inhabited = np.flatnonzero((present[every:] & present[:-every]).any(axis=1)[:windows])
    if not len(inhabited):
        return np.full(windows, windows - 1)
    following = np.searchsorted(inhabited, np.arange(windows))
    return np.asarray(inhabited[np.minimum(following, len(inhabited) - 1)])
