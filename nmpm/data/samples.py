"""Samples of trajectories: some of the particles in successive frames, and all of them in two.

They bound the memory of what is estimated from many trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nmpm.data.format import Trajectory

_BYTES = 2**21  # of the positions of one trajectory
_PARTICLES = 256  # that are kept before frames are left out
_PER_TYPE = 64
_SNAPSHOT = 50_000  # particles


@dataclass(frozen=True)
class Typed:
    """Positions of particles, and their types."""

    position: np.ndarray  # (..., N, D)
    types: np.ndarray  # (N,)

    def of(self, types: frozenset[int]) -> np.ndarray:
        """Positions (..., N', D) float64 of the particles of some types."""
        return self.position[..., np.isin(self.types, list(types)), :].astype(np.float64)


@dataclass(frozen=True)
class Sample(Typed):
    """Some particles of a trajectory in successive frames (F, P, D) from its first on; NaN where one is absent."""

    time: np.ndarray | None  # (F,) in the file's unit
    velocity: np.ndarray | None  # (F, P, D) in length per unit of time, where the file has velocities
    first: Typed  # those there, or a compact part of them, in the first frame, or the first of those with most
    last: Typed  # likewise, in the last frame with at least half as many

    def times(self, dt: float) -> np.ndarray:
        """(F,) times of the frames in units of dt; their numbers where no times are recorded, or other ones."""
        frames = np.arange(len(self.position), dtype=np.float64)
        if self.time is None or not np.isfinite(self.time).all():
            return frames
        times = (self.time - self.time[0]) / dt
        plausible = len(frames) < 2 or abs(float(np.median(np.diff(times))) - 1) < 0.1
        return times if plausible and (np.diff(times) > 0).all() else frames


def take_sample(trajectory: Trajectory) -> Sample:
    """A sample of up to 2 MiB of positions, at least 64 particles of each type, and the first and last frame."""
    position, types = trajectory.position, trajectory.particle_type
    frames, particles, dim = position.shape
    row = 4 * dim
    count = min(particles, max(_PARTICLES, _BYTES // (row * frames)))
    index = _spread(types, count)
    length = min(frames, max(2, _BYTES // (row * len(index))))
    present = np.isfinite(position[..., 0]).sum(axis=1)
    fullest, last = int(present.argmax()), int(np.flatnonzero(2 * present >= present.max())[-1])
    time, velocity = trajectory.fields.get("time"), trajectory.fields.get("velocity")
    return Sample(
        position=position[:length, index],
        types=types[index],
        time=None if time is None or np.shape(time) != (frames,) else np.asarray(time, np.float64)[:length],
        velocity=None if velocity is None or velocity.shape != position.shape else velocity[:length, index],
        first=_snapshot(position[fullest], types),
        last=_snapshot(position[last], types),
    )


def _spread(types: np.ndarray, count: int) -> np.ndarray:
    """Sorted indices of about `count` random particles, of each type in proportion but at least 64."""
    rng = np.random.default_rng(0)
    kept = []
    for kind in np.unique(types):
        indices = np.flatnonzero(types == kind)
        wanted = min(len(indices), max(_PER_TYPE, round(count * len(indices) / len(types))))
        kept.append(rng.choice(indices, wanted, replace=False))
    return np.sort(np.concatenate(kept))


def _snapshot(frame: np.ndarray, types: np.ndarray) -> Typed:
    """The particles of a frame (N, D) that are there; of a type with many, those amid its longest axis."""
    present = np.isfinite(frame).all(axis=1)
    points, kinds = frame[present].astype(np.float64), types[present]
    kept = [np.flatnonzero(kinds == kind) for kind in np.unique(kinds)]
    for place, indices in enumerate(kept):
        if len(indices) > _SNAPSHOT:
            along = points[indices, int(np.argmax(np.ptp(points[indices], axis=0)))]
            middle = (len(indices) - _SNAPSHOT) // 2
            kept[place] = indices[np.argsort(along, kind="stable")[middle : middle + _SNAPSHOT]]
    return Typed(points[np.concatenate(kept)], kinds[np.concatenate(kept)])
