"""Tiny trajectories that nothing simulated, and their metadata."""

from pathlib import Path

import numpy as np

from nmpm.data.batches import TrajectoryBuffer, WindowPlan
from nmpm.data.convert import Options
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.recordings import SplitRecordings
from nmpm.data.sources import FolderSource


def made_up_trajectory(
    frames: int, particles: int, seed: int = 0, statics: int = 0, dim: int = 2, fields: tuple[str, ...] = ()
) -> Trajectory:
    """Goop (7) that drifts slowly through the middle of [0.1, 0.9] ** dim, and boundary particles (3) that rest.

    Fields evolve; those of particles that rest are NaN.
    """
    rng = np.random.default_rng((seed, frames, particles))
    start = rng.uniform(0.3, 0.7, size=(1, particles + statics, dim))
    drift = rng.normal(scale=1e-3, size=(frames, particles + statics, dim)).cumsum(axis=0)
    drift[:, particles:] = 0
    types = np.r_[np.full(particles, 7), np.full(statics, 3)]
    values = {name: 1 + 0.01 * rng.normal(size=(frames, len(types))).cumsum(axis=0) for name in fields}
    for own in values.values():
        own[:, particles:] = np.nan
    return Trajectory((start + drift).astype(np.float32), types, {"seed": seed}, values)


def made_up_metadata(dim: int = 2, **changes: object) -> Metadata:
    """DeepMind's box and time step, goop and boundary particles, gravity downwards."""
    known: dict = {
        "bounds": ((0.1, 0.9),) * dim,
        "dt": 0.0025,
        "dim": dim,
        "sequence_length": 12,
        "particle_types": {3: "boundary", 7: "goop"},
        "static_types": frozenset({3}),
        "gravity": (0.0,) * (dim - 1) + (-9.81,),
    }
    return Metadata(**(known | changes))


def comes_and_goes(trajectory: Trajectory, seed: int) -> Trajectory:
    """The same with tracks that begin and end, holes, no particle in frame 6, and particle 2 never."""
    rng, position = np.random.default_rng(seed), trajectory.position.copy()
    frames, particles, _ = position.shape
    births, lives = rng.integers(-6, frames - 2, particles), rng.integers(2, 9, particles)
    births[0], lives[0] = 0, frames
    time = np.arange(frames)[:, None]
    there = (time >= births) & (time < births + lives) & (rng.random((frames, particles)) > 0.1)
    there[:, 0], there[:, 2], there[6] = True, False, False
    position[~there] = np.nan
    return Trajectory(position, trajectory.particle_type)


def recordings_of(folder: Path, split: str = "train", **stated: object) -> SplitRecordings:
    """The recordings of a dataset's split, of which a user states some facts."""
    return FolderSource(folder, Options(**stated)).recordings(split)


def buffer_of(folder: Path, **options: object) -> TrajectoryBuffer:
    """Batches of four windows of five frames, from two of the training trajectories at a time."""
    recordings = recordings_of(folder)
    known = {"length": 5, "batch_size": 4, "buffer_size": 2, "passes": 1.0, "seed": 0}
    return TrajectoryBuffer(recordings, WindowPlan(frames=recordings.frames, **(known | options)))
