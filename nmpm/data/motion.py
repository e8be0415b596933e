"""How fast the particles of a dataset move, from a few frames of a few trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nmpm.data.facts import find_facts
from nmpm.data.format import Metadata, Split
from nmpm.data.gravity import Gravity, trajectory_gravity
from nmpm.data.split_files import SPLITS, find_split
from nmpm.data.statistics import displacements
from nmpm.scene import Motion

_TRAJECTORIES, _PAIRS = 8, 12
_QUANTILE = 0.999


def measure_motion(folder: Path, metadata: Metadata) -> Motion:
    """Speeds of the moving particles, from 12 pairs of frames of each of up to 8 trajectories, evenly spaced.

    Of the training's trajectories, or else those of another split. Gravity that is not stated is measured.
    """
    split = Split(find_split(folder, *SPLITS))
    indices = range(0, len(split), -(-len(split) // _TRAJECTORIES))
    speeds = np.concatenate([_speeds(split, index, metadata) for index in indices] or [np.zeros(1)])
    return Motion(
        rms=float(np.sqrt(np.square(speeds).mean())),
        largest=float(np.quantile(speeds, _QUANTILE)),
        gravity=_gravity(split, indices, metadata),
        frames=min(split.frames(index) for index in range(len(split))),
    )


def _gravity(split: Split, indices: range, metadata: Metadata) -> Gravity | None:
    """That of the trajectories, each component's root mean square; where none states any, as particles fall."""
    stated = [trajectory_gravity(split.attributes(index), metadata, split.where(index)) for index in indices]
    pulls = [pull for pull in stated if pull is not None]
    if not pulls:
        return find_facts(split, metadata).gravity.value
    return pulls[0] if len(set(pulls)) == 1 else tuple(np.sqrt(np.mean(np.square(pulls), axis=0)).tolist())


def _speeds(split: Split, index: int, metadata: Metadata) -> np.ndarray:
    """Speeds, in length per frame, of the particles that are there in both frames of a pair."""
    moving = metadata.is_moving(split.particle_type(index))
    starts = np.unique(np.linspace(0, max(0, split.frames(index) - 2), _PAIRS).astype(int))
    pairs = [split.read(index, start, start + 2).position[:, moving] for start in starts.tolist()]
    speeds = [np.linalg.norm(displacements(pair, metadata), axis=-1).ravel() for pair in pairs]
    every: np.ndarray = np.concatenate(speeds)
    return np.asarray(every[~np.isnan(every)])
