"""What a new configuration has to know of a dataset beside its scene, from up to eight training trajectories."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from nmpm._support.progress import progress_bar
from nmpm.data.format import Metadata, Split, Trajectory
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.grid_rule import GridFacts, candidates
from nmpm.data.inspection.irregular_motion import white_noise
from nmpm.data.inspection.measurements import Measurements
from nmpm.data.loading.sources import FolderSource
from nmpm.data.split_files import find_split, split_paths
from nmpm.data.statistics import displacements
from nmpm.data.times import uneven_step, usual_step
from nmpm.scene import Scene

TRAJECTORIES = 8
_ROUNDING = 1e-3  # of the spacing: less noise is that of float32
_NOISY = 0.1  # of a typical step
_STATIONARY = 1.5  # ratio of mean speeds early and late
_NUMBERS = 2**24  # coordinates of a trajectory that are looked at
_FULL = 0.995  # of the occupied cells that are not fuller than the density cap


@dataclass
class Survey:
    """Facts about the training trajectories; lengths in domain length."""

    counts: dict[str, int]  # trajectories of each split
    frames: int = 0  # of the shortest one
    particles: int = 0  # that move, at most
    comings: bool = False  # whether particles come or go
    gain: float | None = None  # most energy gained, of the initial one; None where gravity is not known
    rests: int = 0  # of the trajectories looked at, those that come to rest
    looked_at: int = 0
    early_speed: float = 0.0  # mean over the first tenth of the frames, per frame
    late_speed: float = 0.0  # median over the last tenth
    mean_late_speed: float = 0.0
    uneven: float = 0.0  # usual time between frames, where it is uneven
    noise: float = 0.0  # standard deviation of positions, where they are noisy
    noise_share: float = 0.0  # of a typical step
    grids: tuple[GridFacts, ...] = ()
    late: list[np.ndarray] = field(default_factory=list)  # positions (N, D) in last frames

    @property
    def settles(self) -> bool:
        """Whether most trajectories come to rest before they end."""
        return 2 * self.rests > self.looked_at

    @property
    def stationary(self) -> bool:
        """Whether trajectories end as lively as they begin."""
        low, high = sorted((self.early_speed, self.mean_late_speed))
        return high < _STATIONARY * low

    def crowding(self, scene: Scene, shape: Sequence[int]) -> float:
        """Volume fraction that the fullest 0.5% of the occupied cells exceed in last frames, linearly rasterised."""
        low, high = np.asarray(scene.domain).T
        spacing = (high - low) / np.asarray(shape)
        share = scene.particle_volume / float(spacing.prod())
        filled = [share * _linear_counts((position - low) / spacing, shape) for position in self.late]
        values = np.concatenate([np.empty(0), *(each[each > 0.5] for each in filled)])
        return float(np.quantile(values, _FULL)) if len(values) else 0.0


def survey(source: FolderSource) -> Survey:
    """Looks at a dataset, with a progress bar; raises a DataError if its training trajectories cannot be read."""
    metadata, scene = source.metadata, source.scene
    counts = {name: len(Split(path)) for name, path in split_paths(source.folder).items()}
    split = Split(find_split(source.folder, "train"))
    facts = Survey(counts, frames=min(split.frames(index) for index in range(len(split))))
    measured = Measurements(metadata, scene.domain, candidates(scene.domain, scene.particle_spacing))
    sample = range(0, len(split), -(-len(split) // TRAJECTORIES))
    with progress_bar("Looking at the data", len(sample)) as advance:
        for index in sample:
            trajectory = split.read(index)
            gravity = trajectory_gravity(trajectory.attributes, scene, split.where(index))
            measured.add(trajectory)
            time = split.time(index)
            if time is not None and uneven_step(time) is not None:
                facts.uneven = usual_step(time)
            _add(facts, trajectory, metadata, replace(scene, gravity=gravity))
            advance()
    facts.rests = sum(rest is not None for rest in measured.rests)
    facts.grids = measured.grids()
    return facts


def _add(facts: Survey, trajectory: Trajectory, metadata: Metadata, scene: Scene) -> None:
    every = trajectory.position[:, metadata.is_moving(trajectory.particle_type)]
    present = np.isfinite(every[..., 0])
    facts.looked_at += 1
    facts.particles = max(facts.particles, int(present.sum(axis=1).max(initial=0)))
    facts.comings |= not bool(present.all())
    facts.late += [frame[there].astype(np.float64) for frame, there in zip(every[-3:], present[-3:], strict=True)]
    position = every[:, :: -(-every.size // _NUMBERS) or 1]  # some particles of large trajectories
    step = displacements(position, metadata)
    if len(step) < 3 or not np.isfinite(step).any():
        return
    speed, tenth = np.linalg.norm(step, axis=2), -(-len(step) // 10)
    share = 1 / facts.looked_at
    for name, value in (
        ("early_speed", np.nanmean(speed[:tenth])),
        ("mean_late_speed", np.nanmean(speed[-tenth:])),
        ("late_speed", np.nanmedian(speed[-tenth:])),
    ):
        setattr(facts, name, (1 - share) * getattr(facts, name) + share * float(value))
    noise, typical = white_noise(step)
    if noise > max(_NOISY * typical, _ROUNDING * scene.particle_spacing):
        facts.noise, facts.noise_share = noise, noise / typical
    gain = None if facts.comings else energy_gain(position.astype(np.float64), step, scene)
    facts.gain = gain if facts.looked_at == 1 or facts.gain is None or gain is None else max(facts.gain, gain)


def energy_gain(position: np.ndarray, step: np.ndarray, scene: Scene) -> float | None:
    """Most kinetic and potential energy that particles (T, N, D) gain, of the initial one above the lowest corner.

    None where it is not defined: gravity is not known, or acts along a periodic axis.
    """
    if scene.gravity is None or any(g and wraps for g, wraps in zip(scene.gravity, scene.periodic, strict=True)):
        return None
    gravity = np.asarray(scene.gravity) * scene.dt**2
    low, high = np.asarray(scene.bounds).T
    lowest = -float(np.maximum(gravity * low, gravity * high).sum())
    height = (position[1:] + position[:-1]) / 2 @ gravity
    energy = ((step**2).sum(axis=2) / 2 - height).mean(axis=1)
    initial = energy[0] - lowest
    return float((energy.max() - energy[0]) / initial) if initial > 0 else math.inf


def _linear_counts(cells: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """(prod(S),) particles (N, D), in cells, spread over the centres of the cells around them."""
    counts = np.zeros(math.prod(shape))
    first = np.floor(cells - 0.5).astype(int)
    part = cells - 0.5 - first
    for corner in _corners(len(shape)):
        weight = np.where(corner, part, 1 - part).prod(axis=1)
        index = np.clip(first + corner, 0, np.asarray(shape) - 1)
        counts += np.bincount(np.ravel_multi_index(tuple(index.T), tuple(shape)), weight, len(counts))
    return counts


def _corners(dim: int) -> Iterator[np.ndarray]:
    yield from np.stack(np.meshgrid(*[[0, 1]] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
