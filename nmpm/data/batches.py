"""Which training windows make up which batch.

The trajectories of a dataset, reshuffled in each pass, form an endless sequence; buffer b is its b-th slice of
`buffer_size`. The windows of a buffer, reshuffled in each pass, form another endless sequence; batches are consecutive
slices of it, assigned to the ranks in turn, until `passes` times as many windows as an average buffer holds have been
drawn. So all windows are equally likely, no two ranks see the same window within a pass, and batch i of a rank is a
pure function of the seed and the data: a resumed training has the same batches as an uninterrupted one. The batches of
all ranks together equal that of one process with a batch as large; where the batch size or the number of ranks
changes, training continues in the same sequence of windows (`WindowPlan.resume_after`).

Batches are padded to their largest scene. So that one large scene does not make many small ones pay, the windows of
several batches in a row, a bucket, may be sorted by their number of particles and dealt to these batches anew. Each
window is drawn as often as without; only its company changes.

A `WindowPlan` says in advance which windows make up which batch. A buffer holds the trajectories of the next batches
in one padded tensor, so that a batch is one gather; a thread reads the trajectories after them in the meantime.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import count, groupby
from typing import ClassVar, Protocol, Self, TypeVar

import numpy as np
import torch

from nmpm._support.threads import Task
from nmpm.data.windows import PaddedRecordings, Recording, displacements, first_frames, overlap
from nmpm.errors import ConfigError
from nmpm.particles import Window
from nmpm.scene import Reading, Scene

T = TypeVar("T")
Drawn = tuple[int, int]
"""A window: index of its trajectory, and its first frame there."""

_TRAJECTORIES, _WINDOWS, _MOTION, _BUCKETS, _OPENINGS = 0, 1, 2, 3, 4  # separate the streams of random numbers

OPENING = 16
"""Frames that count as the opening of a trajectory."""


@dataclass(frozen=True)
class PlanStart:
    """Where the batches of the current size start in the sequence of windows."""

    batch: int = 0  # index of the first of them
    buffer: int = 0  # index of the buffer that it is drawn from
    drawn: int = 0  # windows of that buffer that were drawn before


@dataclass(frozen=True)
class WindowPlan:
    """Assigns windows to batches. Arguments that are not listed are as for `TrajectoryDataModule`.

    Args:
        frames: Frames of each trajectory of the dataset.
        length: Frames of a window, of the dataset as `frames`.
        start: Where the batches of this size start, if there were batches of another size before.
        bucket: `bucket_batches`.

    Raises:
        ConfigError: if a number is out of its range.
    """

    shared: ClassVar[bool] = True
    """Whether all ranks have the same buffer."""

    frames: tuple[int, ...]
    length: int
    batch_size: int
    buffer_size: int
    passes: float
    seed: int
    emphasis: float = 0.0
    start: PlanStart = PlanStart()
    bucket: int = 1
    openings: float = 0.0

    def __post_init__(self) -> None:
        for name in ("batch_size", "buffer_size", "passes", "bucket"):
            if getattr(self, name) <= 0:
                raise ConfigError(f"{name} = {getattr(self, name)} must be positive.")
        if self.seed < 0:
            raise ConfigError(f"seed = {self.seed} must not be negative.")
        for name in ("emphasis", "openings"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} = {getattr(self, name)} must be between 0 and 1: a fraction of the windows.")

    def windows(self, trajectory: int) -> int:
        """Number of windows in a trajectory."""
        return self.frames[trajectory] - self.length + 1

    def batches_per_buffer(self, world: int) -> int:
        """Number of batches that each of `world` ranks draws from a buffer before the next one."""
        average = sum(map(self.windows, range(len(self.frames)))) / len(self.frames)
        drawn = self.passes * average * min(self.buffer_size, len(self.frames))
        return max(1, round(drawn / (self.batch_size * world)))

    def members(self, buffer: int, rank: int = 0, world: int = 1) -> tuple[int, ...]:  # noqa: ARG002
        """Indices of the trajectories in a rank's buffer, unique and ascending."""
        total = len(self.frames)
        if total <= self.buffer_size:
            return tuple(range(total))
        positions = range(buffer * self.buffer_size, (buffer + 1) * self.buffer_size)
        return tuple(sorted({int(_shuffle(total, self.seed, _TRAJECTORIES, p // total)[p % total]) for p in positions}))

    def locate(self, index: int, world: int) -> tuple[int, int]:
        """Index of the buffer that a batch is drawn from, and the number of its windows drawn before."""
        buffer, drawn, batches = self._buffer_of(index, world)
        return buffer, drawn + (index - batches.start) * self._stride(world)

    def _buffer_of(self, index: int, world: int) -> tuple[int, int, range]:
        """A batch's buffer, the number of its windows drawn before its first batch, and the indices of its batches."""
        start, count = self.start, self.batches_per_buffer(world)
        left = max(0, count - start.drawn // self._stride(world))
        if index - start.batch < left:
            return start.buffer, start.drawn, range(start.batch, start.batch + left)
        buffers = (index - start.batch - left) // count
        first = start.batch + left + buffers * count
        return start.buffer + 1 + buffers, 0, range(first, first + count)

    def batch(self, index: int, rank: int, world: int) -> list[Drawn]:
        """The windows of a rank's batch before buckets are dealt, each as (trajectory index, first frame)."""
        first = (rank - self.drawing_ranks(rank, world).start) * self.batch_size
        return self.draw(index, rank, world)[first : first + self.batch_size]

    def draw(self, index: int, rank: int, world: int) -> list[Drawn]:
        """As `batch`, of all ranks that share a rank's buffer, one after the other."""
        buffer, drawn = self.locate(index, world)
        members = self.members(buffer, rank, world)
        ends = np.cumsum([self.windows(trajectory) for trajectory in members])
        total = int(ends[-1])
        positions = range(drawn, drawn + self._stride(world))
        numbers = [int(_shuffle(total, self.seed, _WINDOWS, buffer, p // total)[p % total]) for p in positions]
        owners = np.searchsorted(ends, numbers, side="right").tolist()
        return [
            (members[owner], number - int(ends[owner]) + self.windows(members[owner]))
            for owner, number in zip(owners, numbers, strict=True)
        ]

    def emphasise(
        self, drawn: Sequence[Drawn], window_at: Callable[[float], Drawn], index: int, rank: int, world: int
    ) -> list[Drawn]:
        """The windows of a rank's batch, a share of them replaced by `window_at` of random quantiles in [0, 1)."""
        rng = np.random.default_rng((self.seed, _MOTION, index, 0))

        def draw_quantiles(count: int) -> np.ndarray:
            replaced = rng.random(count) < self.emphasis
            quantiles = np.full(count, np.nan)
            quantiles[replaced] = rng.random(int(replaced.sum()))
            return quantiles

        quantiles = _draw_for_rank(draw_quantiles, len(drawn), rank, world)
        return [w if np.isnan(quantile) else window_at(quantile) for w, quantile in zip(drawn, quantiles, strict=True)]

    def move_to_openings(self, drawn: Sequence[Drawn], index: int, rank: int, world: int) -> list[Drawn]:
        """The windows of a rank's batch, a share of them moved to the openings of their trajectories."""
        rng = np.random.default_rng((self.seed, _OPENINGS, index, 0))
        moved = _draw_for_rank(lambda count: rng.random(count) < self.openings, len(drawn), rank, world)
        firsts = _draw_for_rank(lambda count: rng.integers(0, OPENING, count), len(drawn), rank, world)
        return [
            (trajectory, min(int(first), self.windows(trajectory) - 1) if move else frame)
            for (trajectory, frame), move, first in zip(drawn, moved, firsts, strict=True)
        ]

    def bucket_of(self, index: int, world: int) -> range:
        """Indices of the batches whose windows are sorted together with those of a batch; all of one buffer."""
        _, _, batches = self._buffer_of(index, world)
        low = batches.start + (index - batches.start) // self.bucket * self.bucket
        return range(low, min(low + self.bucket, batches.stop))

    def deal(self, bucket: range, windows: Sequence[T], sizes: Sequence[int]) -> list[list[T]]:
        """The windows of a bucket's batches, in order and of all ranks together, dealt to these batches by size."""
        share = len(windows) // len(bucket)
        if len(bucket) == 1:
            return [list(windows)]
        by_size = [windows[number] for number in np.argsort(sizes, kind="stable").tolist()]
        batches = [by_size[first : first + share] for first in range(0, len(windows), share)]
        return [batches[turn] for turn in _shuffle(len(bucket), self.seed, _BUCKETS, bucket.start)]

    def drawing_ranks(self, rank: int, world: int) -> range:
        """The ranks that share the buffer of a rank, so that their windows are dealt together."""
        return range(world) if self.shared else range(rank, rank + 1)

    def resume_after(self, batches: int, batch_size: int, earlier: int, world: int) -> Self:
        """The plan that continues after batches of another size, at the first window that none of them used.

        With buckets, the windows of an unfinished one that no batch has used are left out.

        Args:
            batches: Batches that each rank has used, since the beginning.
            batch_size: Windows in each of those since `start`.
            earlier: Number of ranks that used them.
            world: Number of ranks from now on.
        """
        if batch_size * earlier == self.batch_size * world or batches == self.start.batch:
            return self
        before = replace(self, batch_size=batch_size)
        # The rest of a buffer may be too small for the old batches, but not for the new.
        buffer, drawn = before.locate(before.bucket_of(batches - 1, earlier)[-1], earlier)
        return replace(self, start=PlanStart(batches, buffer, drawn + before._stride(earlier)))

    def _stride(self, world: int) -> int:
        """Windows of a buffer that one batch of all ranks that share it uses."""
        return self.batch_size * (world if self.shared else 1)


@dataclass(frozen=True)
class EndlessWindowPlan(WindowPlan):
    """A plan for endless trajectories, such as a simulator gives: each buffer of each rank has other trajectories.

    Args:
        frames: Frames of each trajectory of a buffer, all equal.
    """

    shared: ClassVar[bool] = False

    def windows(self, trajectory: int) -> int:  # noqa: ARG002
        return self.frames[0] - self.length + 1

    def batches_per_buffer(self, world: int) -> int:  # noqa: ARG002
        return super().batches_per_buffer(1)

    def members(self, buffer: int, rank: int = 0, world: int = 1) -> tuple[int, ...]:
        first = (buffer * world + rank) * self.buffer_size
        return tuple(range(first, first + self.buffer_size))

    def resume_after(self, batches: int, batch_size: int, earlier: int, world: int) -> Self:
        """Continues with the first buffer that no rank has started."""
        if (batch_size, earlier) == (self.batch_size, world):
            return self
        buffer, drawn = replace(self, batch_size=batch_size).locate(batches, earlier)
        started = (buffer + (drawn > 0)) * earlier
        return replace(self, start=PlanStart(batches, -(-started // world)))


def _draw_for_rank(draw: Callable[[int], np.ndarray], count: int, rank: int, world: int) -> np.ndarray:
    """A rank's `count` of the random numbers that a single process with one large batch would draw."""
    return draw(count * world)[rank * count : (rank + 1) * count]


@lru_cache(maxsize=8)
def _shuffle(total: int, *stream: int) -> np.ndarray:
    """A permutation of range(total) that depends on the stream alone."""
    order = np.random.default_rng(stream).permutation(total)
    order.flags.writeable = False
    return order


class RecordingProvider(Protocol):
    """Recorded or simulated trajectories, as a buffer needs them."""

    @property
    def reading(self) -> Reading: ...  # how they are read, and their scene

    @property
    def max_bytes(self) -> int: ...  # of the positions of the largest trajectory

    def load(self, indices: Sequence[int]) -> list[Recording]: ...  # reads or simulates several trajectories

    def close(self) -> None: ...  # stops unfinished work; the provider can be used again afterwards


class MotionSampler:
    """Draws windows of `length` frames of the data in proportion to the mean distance that their particles travel."""

    def __init__(self, recordings: Mapping[int, Recording], scene: Scene, length: int) -> None:
        distances = {index: _window_distances(recording, scene, length) for index, recording in recordings.items()}
        self.windows = [(index, start) for index, distance in distances.items() for start in range(len(distance))]
        self.cumulative = np.cumsum(np.concatenate(list(distances.values())))

    def window_at(self, quantile: float) -> Drawn:
        """The window (trajectory, first frame) at a quantile in [0, 1) of the summed distance.

        Any window where nothing moves.
        """
        distance = quantile * self.cumulative[-1]
        return self.windows[min(int(np.searchsorted(self.cumulative, distance, side="right")), len(self.windows) - 1)]


def _window_distances(recording: Recording, scene: Scene, length: int) -> np.ndarray:
    """Mean distance that a particle travels within each window of `length` frames, (windows,)."""
    steps = displacements(recording.frames, scene).numpy()
    squares = (np.square(steps[..., axis]) for axis in range(steps.shape[-1]))
    speed = np.sqrt(sum(squares))  # (`np.linalg.norm` takes four times as long)
    if recording.present is None:
        mean = speed.mean(axis=-1, dtype=np.float64)
    else:
        there = (recording.present[1:] & recording.present[:-1]).numpy()
        mean = (speed * there).sum(axis=-1, dtype=np.float64) / np.maximum(there.sum(axis=-1), 1)
    total = np.concatenate([[0.0], np.cumsum(mean)])
    return np.asarray(total[length - 1 :] - total[: len(total) - length + 1])


@dataclass(frozen=True)
class _BufferContents:
    """The trajectories of one buffer."""

    padded: PaddedRecordings  # all of them, one per row, in the order of `recordings`
    recordings: Mapping[int, Recording]  # views by index of the trajectory, without padding, in host memory
    motion: MotionSampler | None  # draws windows in proportion to motion; None where the plan has no emphasis
    length: int  # frames of the data in a window

    @cached_property
    def rows(self) -> dict[int, int]:
        """The row of each trajectory in `padded`."""
        return {trajectory: row for row, trajectory in enumerate(self.recordings)}

    @cached_property
    def first_frames(self) -> dict[int, np.ndarray]:
        """For trajectories with absent particles, the frame at which a window that is drawn starts instead."""
        present = {trajectory: recording.present for trajectory, recording in self.recordings.items()}
        every = self.padded.reading.every
        return {i: first_frames(mask.numpy(), self.length, every) for i, mask in present.items() if mask is not None}

    def start_inhabited(self, drawn: Drawn) -> Drawn:
        """The same window, or the next in whose first two frames there is a particle."""
        trajectory, first = drawn
        return (trajectory, int(self.first_frames[trajectory][first])) if trajectory in self.first_frames else drawn

    def size(self, drawn: Drawn) -> int:
        """Number of particles of a window."""
        trajectory, first = drawn
        if self.padded.tracks is None:
            return self.recordings[trajectory].frames.shape[1]
        return int(np.count_nonzero(overlap(self.padded.tracks[self.rows[trajectory]], first, self.length)))

    def gather(self, drawn: Sequence[Drawn], particles: int) -> Window:
        """The windows, padded to a number of particles."""
        trajectories, starts = zip(*drawn, strict=True)
        rows = [self.rows[trajectory] for trajectory in trajectories]
        return self.padded.gather(rows, starts, self.length, particles)


class TrajectoryBuffer:
    """Endless batches of training windows, from trajectories in memory on a device.

    While one buffer is in use, a thread reads the next: up to three times `plan.buffer_size` trajectories are in
    memory, however large the dataset is.

    Windows start where particles are: the next in whose first two frames there is one takes the place of a window that
    starts in missing frames.

    Args:
        provider: The trajectories, none shorter than a window.
        plan: Which of their windows make up which batch.
        device: Where the buffer is; the CPU when None.
    """

    def __init__(self, provider: RecordingProvider, plan: WindowPlan, device: torch.device | None = None) -> None:
        self.provider, self.plan, self.device = provider, plan, device or torch.device("cpu")

    def batches(self, start: int = 0, rank: int = 0, world: int = 1) -> Iterator[Window]:
        """Yields the batches of one of `world` ranks, from index `start` on; a DataError if a trajectory does not fit.

        Closing the iterator stops its reading thread and waits for it.
        """
        plan = self.plan
        contents = self._load(plan.members(plan.locate(start, world)[0], rank, world), None)
        for buffer, indices in groupby(count(start), key=lambda index: plan.locate(index, world)[0]):
            upcoming = Task(partial(self._load, plan.members(buffer + 1, rank, world), contents))
            try:
                bucket, dealt = range(0), []
                for index in indices:
                    if index not in bucket:
                        bucket = plan.bucket_of(index, world)
                        dealt = self._deal(bucket, contents, rank, world)
                    batch = dealt[index - bucket.start]
                    # The largest of all ranks: noise is drawn for tensors of equal shape on all of them.
                    most = max(map(contents.size, batch))
                    first = (rank - plan.drawing_ranks(rank, world).start) * plan.batch_size
                    yield contents.gather(batch[first : first + plan.batch_size], most)
                contents = upcoming.result()
            finally:
                upcoming.cancel()

    def _deal(self, bucket: range, contents: _BufferContents, rank: int, world: int) -> list[list[Drawn]]:
        """The windows of each of a bucket's batches, of all ranks that share the buffer."""
        # Random numbers are drawn for all ranks: for those that share the buffer, as for one large batch.
        numbers = (0, 1) if self.plan.shared else (rank, world)
        drawn: list[Drawn] = []
        for index in bucket:
            windows = self.plan.draw(index, rank, world)
            if contents.motion is not None:
                windows = self.plan.emphasise(windows, contents.motion.window_at, index, *numbers)
            if self.plan.openings:
                windows = self.plan.move_to_openings(windows, index, *numbers)
            drawn += map(contents.start_inhabited, windows)
        return self.plan.deal(bucket, drawn, [contents.size(window) for window in drawn])

    def _load(self, members: Sequence[int], previous: _BufferContents | None) -> _BufferContents:
        """Loads a buffer's trajectories, reusing those of the previous buffer."""
        former = previous.recordings if previous is not None else {}
        if previous is not None and list(members) == list(former):
            return previous
        missing = [index for index in members if index not in former]
        new = dict(zip(missing, self.provider.load(missing), strict=True))
        loaded = [former[index] if index in former else new[index] for index in members]
        padded = PaddedRecordings.stack(loaded, self.provider.reading)
        # Views of the padded tensor, so that the memory of the loaded recordings is freed.
        recordings = {index: padded.recording(row, loaded[row]) for row, index in enumerate(members)}
        scene = self.provider.reading.scene
        motion = MotionSampler(recordings, scene, self.plan.length) if self.plan.emphasis else None
        return _BufferContents(padded.to(self.device), recordings, motion, self.plan.length)
