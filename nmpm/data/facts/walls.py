"""Walls: coordinates at which particles stop or turn, in one trajectory after another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_TOUCH = 0.5  # of the spacing: how far from the outermost coordinate a particle touches
_ARRIVAL = 0.25  # of the spacing: how far it came from, at least
_ALIKE = 1.0  # of the spacing: by how much trajectories' outermost coordinates may differ
_CROSSED = 2.0  # of the spacing: no wall lets a particle through by that much
_RESTS = 0.02  # of the spacing: particles that move less in the last frame are at rest
_SHARE = 0.003  # of a trajectory's particles, that must touch
_SINGLE_SHARE = 0.02  # the same where there is one trajectory: crests of waves turn as well
_LEAST = 3  # particles
_SLIDE = 0.25  # of the frames, in which a particle that slides along touches


@dataclass(frozen=True)
class Wall:
    """Where an end of an axis is, and in how many trajectories it was touched."""

    coordinate: float
    touched: int  # trajectories
    trajectories: int

    @property
    def certain(self) -> bool:
        """Whether it was touched in several trajectories, so that no single event explains it."""
        return self.touched >= 3 or self.touched == self.trajectories >= 2


def find_wall(positions: Sequence[np.ndarray], axis: int, upper: bool, spacing: float) -> Wall | None:
    """The wall at an end of an axis, in positions (F, N, D) of each trajectory; None where none is touched."""
    share = _SHARE if len(positions) > 1 else _SINGLE_SHARE
    outermost_of_each = (_touch(each, axis, upper, spacing, share) for each in positions)
    touches = [touch for touch in outermost_of_each if touch is not None]
    if not touches:
        return None
    outermost = min(touches)
    count = sum(touch < outermost + _ALIKE * spacing for touch in touches)
    if count < min(2, len(positions)):
        return None
    return Wall(-outermost if upper else outermost, count, len(positions))


def _touch(position: np.ndarray, axis: int, upper: bool, spacing: float, share: float) -> float | None:
    """The lowest coordinate (negated at an upper end) where enough particles of a trajectory stop, turn or slide."""
    along = -position[..., axis] if upper else position[..., axis]
    seen = np.isfinite(along).any(axis=0)
    if not seen.any():
        return None
    height = np.where(np.isfinite(along[:, seen]), along[:, seen], np.inf)
    lowest = height.min(axis=0)
    when = height.argmin(axis=0)
    before = np.arange(len(height))[:, None] < when
    came = np.where(before & np.isfinite(height), height, -np.inf).max(axis=0) > lowest + _ARRIVAL * spacing
    final = height[-1] < lowest + _TOUCH * spacing
    rests = np.abs(along[-1, seen] - along[-2:, seen][0]) < _RESTS * spacing
    stops = ~final | rests
    near = height < lowest + _ARRIVAL * spacing
    others = np.delete(position[:, seen], axis, axis=2)
    slides = (near.mean(axis=0) > _SLIDE) & _moves(others, near, 2 * spacing)
    touching = np.sort(lowest[(came & stops) | slides])
    least = max(min(_LEAST, len(lowest)), round(share * len(lowest)))
    if len(touching) < least:
        return None
    bottom = float(touching[least - 1])
    deepest = float(np.sort(lowest)[min(len(lowest), least) - 1])
    # Where others were deeper without stopping, or one far deeper, this is no wall.
    crossed = deepest < bottom - _TOUCH * spacing or lowest.min() < bottom - _CROSSED * spacing
    return None if crossed else bottom


def _moves(others: np.ndarray, near: np.ndarray, distance: float) -> np.ndarray:
    """Whether each particle (F, N, D - 1) moves further than that in frames where it is near."""
    if not others.shape[2]:
        return np.zeros(others.shape[1], bool)
    masked = np.where(near[..., None], others, np.nan)
    low, high = np.fmin.reduce(masked, axis=0), np.fmax.reduce(masked, axis=0)
    moves: np.ndarray = np.nan_to_num(high - low).max(axis=1) > distance
    return moves
