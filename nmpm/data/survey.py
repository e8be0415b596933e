"""Measurements of recorded trajectories."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nmpm.data.boundaries import OUTWARD, find_crossings
from nmpm.data.facts import find_facts
from nmpm.data.format import SPLITS, Metadata, Split, Trajectory, find_split
from nmpm.data.gravity import Gravity, Track, distinct_gravities, find_gravity, trajectory_gravity
from nmpm.data.grid_rule import GridFacts, candidates, grid_shape
from nmpm.data.spacing import is_dense, neighbour_tree, spacing_of
from nmpm.data.statistics import Extent, displacements, evenly, lengths, without_those_gone
from nmpm.data.times import recorded_step, uneven_step, usual_step
from nmpm.errors import DataError
from nmpm.scene import Motion, Scene

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_FIRST_STEPS = 32  # in which particles are looked for that fly freely
LEAST_PARTICLES = 8
"""Of fewer, neither flights nor volumes are compared with what is stated."""
_NEAR = 1.5  # spacings
_LEAST_FRAMES = 8  # in which noise is measured
_WHITE = -0.6  # correlation of accelerations one frame apart: -2/3 for such errors, -1/2 for random walks
_NOISY, _ROUNDING = 0.1, 1e-3  # of a typical displacement, and of the spacing: less noise is none, or that of float32
_SPACING_FRAMES = 5


@dataclass(frozen=True)
class RecordedMotion:
    """The motion of a trajectory's N moving particles over T frames; NaN where a particle is absent."""

    trajectory: Trajectory  # with its fields
    metadata: Metadata  # as stated
    where: str  # the trajectory in words, e.g. "train 00003"

    @cached_property
    def index(self) -> np.ndarray:
        """(N,) indices of the particles in the trajectory."""
        return np.flatnonzero(self.metadata.is_moving(self.trajectory.particle_type))

    @cached_property
    def position(self) -> np.ndarray:
        """(T, N, D); absent is also who has left the bounds of an open axis."""
        return without_those_gone(self.trajectory.position[:, self.index], self.metadata)

    @cached_property
    def step(self) -> np.ndarray:
        """(T - 1, N, D) displacements between successive frames, by minimum image on periodic axes."""
        return displacements(self.position, self.metadata)

    @cached_property
    def speed(self) -> np.ndarray:
        """(T - 1, N) lengths of the displacements."""
        return np.asarray(np.linalg.norm(self.step, axis=-1))

    @cached_property
    def change(self) -> np.ndarray:
        """(T - 2, N) lengths of the differences of successive displacements."""
        return lengths(np.diff(self.step, axis=0))

    @cached_property
    def typical(self) -> np.ndarray:
        """(T - 1,) root mean square displacement between successive frames; NaN where no particle is in both."""
        count = np.isfinite(self.speed).sum(axis=1)
        return np.asarray(np.sqrt(np.nansum(self.speed**2, axis=1) / np.where(count, count, np.nan)))

    @cached_property
    def present(self) -> np.ndarray:
        """(T, N) whether each particle is there."""
        return np.asarray(~np.isnan(self.position[..., 0]))

    @cached_property
    def extent(self) -> np.ndarray:
        """(D, 2) lowest and highest coordinates."""
        return np.stack([ends.reduce(self.position, axis=(0, 1)) for ends in (np.fmin, np.fmax)], 1, dtype=np.float64)

    @cached_property
    def stays(self) -> np.ndarray:
        """(D, 2) share of the frames in which a particle is within a spacing of the lowest or highest coordinates."""
        low, high = self.extent.T + np.array([[self.spacing], [-self.spacing]])
        return np.stack([near.any(axis=1).mean(axis=0) for near in (self.position < low, self.position > high)], axis=1)

    @cached_property
    def crossings(self) -> np.ndarray:
        """(D, T - 1, N) whether a particle crosses the ends of all positions, on axes that are not periodic."""
        return find_crossings(self.step, np.ptp(self.extent, axis=1), self.spacing, self.metadata.periodic)

    @cached_property
    def wraps(self) -> np.ndarray:
        """(D,) number of steps across the ends of a periodic axis, in coordinates that wrap or do not."""
        counts = np.zeros(self.metadata.dim, dtype=int)
        for axis in np.flatnonzero(self.metadata.periodic):
            lower, upper = self.metadata.bounds[axis]
            x = self.position[..., axis].astype(np.float64)
            crosses = np.diff(np.floor((x - lower) / (upper - lower)), axis=0) != 0
            counts[axis] = ((crosses | (np.abs(np.diff(x, axis=0)) > (upper - lower) / 2)) & self.present[1:]).sum()
        return counts

    @cached_property
    def bounces(self) -> np.ndarray:
        """(D, 2) how often particles near the lower or upper end of a periodic axis turn back from it, or stop."""
        counts = np.zeros((self.metadata.dim, 2), dtype=int)
        for axis in np.flatnonzero(self.metadata.periodic):
            x, step = self.position[1:-1, :, axis], self.step[..., axis]
            for end, bound in enumerate(self.metadata.bounds[axis]):
                outward = step if end else -step
                near = np.abs(x - bound) < _NEAR * self.spacing
                counts[axis, end] = (near & (outward[:-1] > OUTWARD * self.spacing) & (outward[1:] <= 0)).sum()
        return counts

    @cached_property
    def stated_gravity(self) -> Gravity | None:
        """The gravity that the trajectory or the metadata state; raises a DataError for a wrong attribute."""
        return trajectory_gravity(self.trajectory.attributes, self.metadata, self.where)

    @cached_property
    def recorded_step(self) -> float | None:
        """The usual step of recorded times, if there are any."""
        return recorded_step(self.trajectory)

    @cached_property
    def fall(self) -> Gravity | None:
        """The acceleration (D,) of particles in free flight in first frames, in length per frame²; None if none are.

        It is zero if they fly straight.
        """
        if len(self.index) < LEAST_PARTICLES or len(self.step) < 2 or not self.spacing:
            return None
        path = self.position[0] + np.cumsum(np.insert(self.step[:_FIRST_STEPS], 0, 0.0, axis=0), axis=0)
        gravity = find_gravity([Track(path, np.arange(len(path), dtype=np.float64))], self.spacing, 1.0, closed=False)
        straight = gravity.value is not None and not any(gravity.value)
        return gravity.value if gravity.sure == "measured" or straight else None

    @cached_property
    def rounding(self) -> float:
        """Distance of the largest coordinate to the next number in float32."""
        return float(np.spacing(np.float32(np.nanmax(np.abs(self.position)))))

    @cached_property
    def spacing(self) -> float:
        """Distance of neighbours on a square lattice that is as dense as the particles; 0 for fewer than two."""
        return spacing_of(self.position[self.fullest], self.metadata)

    @cached_property
    def spacings(self) -> tuple[bool, list[float]]:
        """Whether particles are dense in some of five frames, and their spacings in these, or else in all of them."""
        frames = evenly(len(self.position), _SPACING_FRAMES)
        dense = [frame for frame in frames if is_dense(self.position[frame], self.metadata)]
        spacings = [spacing_of(self.position[frame], self.metadata) for frame in dense or frames]
        return bool(dense), [spacing for spacing in spacings if spacing]

    @cached_property
    def noise(self) -> tuple[float, float]:
        """The standard deviation of errors of positions, and its share of a typical displacement; 0 for small ones.

        Errors that are new in each frame make accelerations alternate: of independent ones of standard deviation σ,
        the second difference has the variance 6 σ², and successive ones correlate by -2/3.
        """
        if len(self.step) < _LEAST_FRAMES or not np.isfinite(self.step).any():
            return 0.0, 0.0
        acceleration = np.diff(self.step, axis=0)
        typical, square, product = (
            float(np.nanmean(each)) for each in (self.step**2, acceleration**2, acceleration[1:] * acceleration[:-1])
        )
        noise, typical = math.sqrt(square / 6), math.sqrt(typical)
        loud = noise > max(_NOISY * typical, _ROUNDING * self.spacing)
        return (noise, noise / typical) if loud and product <= _WHITE * square else (0.0, 0.0)

    @cached_property
    def fullest(self) -> int:
        """The first frame of those with the most particles."""
        return int(np.argmax(self.present.sum(axis=1))) if self.position.size else 0

    def tree(self, frame: int) -> tuple[cKDTree, np.ndarray]:
        """A search tree of the particles of a frame, and their indices among the N."""
        there = np.flatnonzero(self.present[frame])
        return neighbour_tree(self.position[frame, there], self.metadata), there


_ENOUGH = 0.05  # of the typical displacement, for errors of velocities of a smoothed track
_MOST_FRAMES = 15


def smoothing_frames(noise: float) -> int:
    """Frames of local fits that take noise, in typical displacements, out of velocities.

    The slope of a line that is fitted to n positions has errors of sqrt(12 / (n³ - n)) times theirs.
    """
    fits = (n for n in range(5, _MOST_FRAMES, 2) if math.sqrt(12 / (n**3 - n)) * noise < _ENOUGH)
    return next(fits, _MOST_FRAMES)


_MASK_CELLS = 64
_FRAMES_ON_GRIDS = 12
_FAR = 2**40  # cells: overflowed positions are no integers
_REST = 0.02  # of a trajectory's peak speed
_BINS = np.geomspace(1e-9, 1e2, 1101)  # of speeds, in longest sides per frame; 2.3% wide
_STATIONARY = 1.5  # ratio of mean speeds early and late
_FULL = 0.995  # of the occupied cells that are not fuller than the density cap


class Survey:
    """Accumulates what the trajectories of a dataset show; lengths in domain length, speeds in length per frame.

    Sizes, materials and gravities are those of all trajectories, the rest that of those that are added.

    Args:
        splits: The dataset.
        metadata: Facts about it.
        scene: Its scene, if that can be inferred.
        spacing: Of particles, where no scene states their volume; grids are measured whose cells suit it.
    """

    def __init__(
        self, splits: Mapping[str, Split], metadata: Metadata, scene: Scene | None, spacing: float = 1.0
    ) -> None:
        self.metadata, self.scene = metadata, scene
        self.domain = scene.domain if scene else metadata.domain or metadata.bounds
        self.low, high = np.asarray(self.domain).T
        self.extent = high - self.low
        self.longest = float(self.extent.max())
        self.sizes: dict[str, list[tuple[int, int, int]]] = {}  # frames, moving and static particles, by split
        self.materials: dict[str, list[int]] = {}  # particles in each trajectory that has any
        self.gravities: list[Gravity | None] = []
        self.problems: list[str] = []
        for name, split in splits.items():
            self.sizes[name] = [self._add_sizes(split, index) for index in range(len(split))]
        self.added = 0  # trajectories
        self.observed = Extent(metadata.dim)
        self.rests: list[int | None] = []  # first frame at rest
        self.falls: list[np.ndarray] = []  # median accelerations in first frames
        self.present = 0  # moving particles in a frame, at most
        self.comings = False  # whether particles come or go
        self.gains: list[float | None] = []  # of energy, of the initial one; None where it is not defined
        self.uneven = 0.0  # usual time between frames, where it is uneven
        self.noise = (0.0, 0.0)  # of a trajectory whose positions are noisy, see `RecordedMotion`
        self._paces: list[tuple[float, float, float]] = []  # mean early, mean late and median late speed
        self._late: list[np.ndarray] = []  # positions (N, D) in last frames
        self._counts, self._fastest = np.zeros(len(_BINS) + 1), 0.0
        numbers = candidates(self.domain, scene.particle_spacing if scene else spacing)
        self._per_cell: dict[int, list[float]] = {cells: [] for cells in numbers}
        self._mask = np.zeros(math.prod(self.shape(_MASK_CELLS)), bool)
        self._shares: list[float] = []

    def _add_sizes(self, split: Split, index: int) -> tuple[int, int, int]:
        types = split.particle_type(index)
        for number, count in zip(*np.unique(types, return_counts=True), strict=True):
            self.materials.setdefault(self.metadata.particle_types[int(number)], []).append(int(count))
        try:
            self.gravities.append(trajectory_gravity(split.attributes(index), self.metadata, split.where(index)))
        except DataError as error:
            self.problems.append(str(error))
        moving, static = self.metadata.is_moving(types), self.metadata.is_obstacle(types)
        return split.frames(index), int(moving.sum()), int(static.sum())

    def shape(self, cells: int) -> tuple[int, ...]:
        """Cells along each axis for so many along the longest."""
        return grid_shape(self.domain, self.metadata.periodic, cells)

    def add(self, motion: RecordedMotion) -> None:
        """Adds a trajectory."""
        self.added += 1
        types, position = motion.trajectory.particle_type, motion.trajectory.position
        self.observed.add(position[:, self.metadata.is_moving(types) | self.metadata.is_obstacle(types)])
        self.present = max(self.present, int(motion.present.sum(axis=1).max(initial=0)))
        self.comings |= not bool(motion.present.all())
        if motion.present.any():
            if np.isfinite(motion.speed).any():
                self._add_speeds(motion.speed)
            if np.isfinite(acceleration := np.diff(motion.step[:4], axis=0)).any():
                self.falls.append(np.nanmedian(acceleration, axis=(0, 1)))
            self._add_cells(motion.position)

    def _add_speeds(self, speed: np.ndarray) -> None:
        there = np.isfinite(speed)
        self._counts += np.bincount(np.digitize(speed[there] / self.longest, _BINS), minlength=len(self._counts))
        self._fastest = max(self._fastest, float(speed[there].max()))
        quick = np.quantile(np.where(there, speed, 0.0), 0.99, axis=1)
        awake = np.flatnonzero(quick > _REST * quick.max())
        first = int(awake[-1]) + 1 if len(awake) else 0
        self.rests.append(first if first < len(speed) else None)

    def _add_cells(self, position: np.ndarray) -> None:
        for cells in self._per_cell:
            for frame in evenly(len(position), _FRAMES_ON_GRIDS):
                if len(index := self._cells(position[frame], cells)):
                    self._per_cell[cells].append(len(index) / len(np.unique(index)))
        occupied = np.zeros(self._mask.size, bool)
        for frame in position:
            occupied[self._cells(frame, _MASK_CELLS)] = True
        self._shares.append(float(occupied.mean()))
        self._mask |= occupied

    def _cells(self, position: np.ndarray, cells: int) -> np.ndarray:
        """Flat index of the cell that contains each of (N, D) particles that are there, (N',)."""
        shape = np.array(self.shape(cells))
        position = position[~np.isnan(position[:, 0])]
        index = np.clip(np.floor((position - self.low) / self.extent * shape), -_FAR, _FAR).astype(int)
        index = np.where(self.metadata.periodic, index % shape, np.clip(index, 0, shape - 1))
        return np.asarray(np.ravel_multi_index(tuple(index.T), tuple(shape)))

    def add_dynamics(self, motion: RecordedMotion, time: np.ndarray | None, scene: Scene) -> None:
        """Adds what new configurations ask for besides: speeds early and late, energy by a scene's gravity, noise."""
        if time is not None and uneven_step(time) is not None:
            self.uneven = usual_step(time)
        last = motion.position[-3:]
        self._late += [frame[~np.isnan(frame[:, 0])].astype(np.float64) for frame in last]
        step, tenth = motion.step, -(-len(motion.step) // 10)
        if len(step) < 3 or not np.isfinite(step).any():
            return
        early, late = motion.speed[:tenth], motion.speed[-tenth:]
        self._paces.append((float(np.nanmean(early)), float(np.nanmean(late)), float(np.nanmedian(late))))
        self.noise = max(self.noise, motion.noise, key=lambda noise: noise[1])
        self.gains.append(None if self.comings else energy_gain(motion.position.astype(np.float64), step, scene))

    @property
    def frames(self) -> set[int]:
        """Numbers of frames that occur."""
        return {frames for sizes in self.sizes.values() for frames, _, _ in sizes}

    @property
    def shortest(self) -> int:
        """Frames of the shortest training trajectory."""
        return min(frames for frames, _, _ in self.sizes["train"])

    @property
    def particles(self) -> int:
        """Moving particles in a trajectory, at most."""
        return max(moving for sizes in self.sizes.values() for _, moving, _ in sizes)

    def varies(self) -> tuple[str, ...]:
        """What differs between trajectories."""
        sizes = [size for sizes in self.sizes.values() for size in sizes]
        differing = {
            "gravity": len(distinct_gravities(self.gravities)) > 1,
            "materials": any(len(counts) < len(sizes) for counts in self.materials.values()),
            "particles": len({moving for _, moving, _ in sizes}) > 1,
            "frames": len(self.frames) > 1,
            "obstacles": len({static for _, _, static in sizes}) > 1,
        }
        return tuple(what for what, differs in differing.items() if differs)

    def grids(self) -> tuple[GridFacts, ...]:
        """Facts about the data on each candidate grid."""
        speeds = (self._speed_quantile(0.5), min(self._speed_quantile(0.999), self._fastest), self._fastest)
        medians = {cells: float(np.median(values)) if values else 0.0 for cells, values in self._per_cell.items()}
        return tuple(
            GridFacts(cells, self.shape(cells), per_cell, *(speed / (self.longest / cells) for speed in speeds))
            for cells, per_cell in medians.items()
        )

    def _speed_quantile(self, share: float) -> float:
        """A quantile of all speeds, to within 2.3%."""
        total = np.cumsum(self._counts)
        index = int(np.searchsorted(total, share * total[-1])) if total[-1] else 0
        upper = _BINS[min(index, len(_BINS) - 1)]
        return 0.0 if index == 0 else math.sqrt(_BINS[index - 1] * upper) * self.longest

    def occupied(self) -> tuple[float, float]:
        """Share of the domain ever occupied, in all trajectories together and in one of them (median)."""
        return float(self._mask.mean()), float(np.median(self._shares)) if self._shares else 0.0

    @property
    def settles(self) -> bool:
        """Whether most trajectories come to rest before they end."""
        return 2 * sum(rest is not None for rest in self.rests) > self.added

    @property
    def pace(self) -> tuple[float, float, float]:
        """Mean speed over the first and over the last tenth of the frames, and the median over the last."""
        early, late, middle = np.mean(self._paces or [(0.0, 0.0, 0.0)], axis=0).tolist()
        return early, late, middle

    @property
    def stationary(self) -> bool:
        """Whether trajectories end as lively as they begin."""
        low, high = sorted(self.pace[:2])
        return high < _STATIONARY * low

    @property
    def gain(self) -> float | None:
        """Most energy that is gained, of the initial one; None where gravity is not known."""
        gains = [gain for gain in self.gains if gain is not None]
        return max(gains) if gains and len(gains) == len(self.gains) else None

    def crowding(self, scene: Scene, shape: Sequence[int]) -> float:
        """Volume fraction that the fullest 0.5% of the occupied cells exceed in last frames, linearly rasterised."""
        spacing = self.extent / np.asarray(shape)
        share = scene.particle_volume / float(spacing.prod())
        filled = [share * _linear_counts((position - self.low) / spacing, shape) for position in self._late]
        values = np.concatenate([np.empty(0), *(each[each > 0.5] for each in filled)])
        return float(np.quantile(values, _FULL)) if len(values) else 0.0


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
    for corner in itertools.product((0, 1), repeat=len(shape)):
        weight = np.where(corner, part, 1 - part).prod(axis=1)
        index = np.clip(first + corner, 0, np.asarray(shape) - 1)
        counts += np.bincount(np.ravel_multi_index(tuple(index.T), tuple(shape)), weight, len(counts))
    return counts


_TRAJECTORIES, _PAIRS = 8, 12
_QUANTILE = 0.999


def measure_motion(folder: Path, metadata: Metadata) -> Motion:
    """Speeds of the moving particles, from 12 pairs of frames of each of up to 8 trajectories, evenly spaced.

    Of the training's trajectories, or else those of another split. Gravity is that of the trajectories, each
    component's root mean square where it varies; where none states any, it is measured as particles fall.
    """
    split, speeds, stated = Split(find_split(folder, *SPLITS)), [np.zeros(0)], list[Gravity]()
    for index in split.spread(_TRAJECTORIES):
        where = split.where(index)
        if (pull := trajectory_gravity(split.attributes(index), metadata, where)) is not None:
            stated.append(pull)
        for start in evenly(max(1, split.frames(index) - 1), _PAIRS):
            speed = RecordedMotion(split.read(index, start, start + 2), metadata, where).speed
            speeds.append(speed[~np.isnan(speed)])
    every = np.concatenate(speeds)
    if len(set(stated)) > 1:
        stated = [tuple(np.sqrt(np.mean(np.square(stated), axis=0)).tolist())]
    return Motion(
        rms=float(np.sqrt(np.square(every).mean())),
        largest=float(np.quantile(every, _QUANTILE)),
        gravity=stated[0] if stated else find_facts(split, metadata).gravity.value,
        frames=min(split.frames(index) for index in range(len(split))),
    )
