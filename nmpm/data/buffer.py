"""Training windows drawn from a few trajectories at a time.

The trajectories of a dataset, shuffled again and again, form one endless row; buffer b is its b-th slice of
`buffer_size`. The windows of a buffer, shuffled again and again, form another endless row; batch after batch is cut
from it, dealt to the ranks in turn, until `passes` times as many windows as an average buffer holds have been drawn.
So every window is as likely as any other, no rank sees what another sees within a pass, and batch i of a rank is a
pure function of the seed and the data: training that stopped goes on with the batch it would have seen.

Where much of the recordings is rest, a share of the windows can be drawn in proportion to how much moves in them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import count

import numpy as np

from nmpm.data.recording import Recording, Recordings, collate
from nmpm.errors import ConfigError
from nmpm.particles import Window

_TRAJECTORIES, _WINDOWS, _MOTION = 0, 1, 2  # separate the streams of random numbers


@dataclass(frozen=True)
class WindowPlan:
    """Says which windows make up which batch.

    Args:
        frames: Frames of each trajectory of the dataset.
        length: Frames of a window.
        batch_size: Windows in a batch of one rank.
        buffer_size: Trajectories held at a time; all are held when there are no more than that.
        passes: How often a buffer's windows are seen, on average, before the next buffer.
        seed: Another seed gives another order.
        emphasis: Share of the windows that is drawn in proportion to the motion in them, in [0, 1].

    Raises:
        ConfigError: if a number is out of its range.
    """

    frames: tuple[int, ...]
    length: int
    batch_size: int
    buffer_size: int
    passes: float
    seed: int
    emphasis: float = 0.0

    def __post_init__(self) -> None:
        for name in ("batch_size", "buffer_size", "passes"):
            if getattr(self, name) <= 0:
                raise ConfigError(f"{name} = {getattr(self, name)} must be positive.")
        if self.seed < 0:
            raise ConfigError(f"seed = {self.seed} must not be negative.")
        if not 0 <= self.emphasis <= 1:
            raise ConfigError(f"emphasis = {self.emphasis} is a share, from 0 to 1.")

    def windows(self, trajectory: int) -> int:
        """How many windows a trajectory has."""
        return self.frames[trajectory] - self.length + 1

    def batches_per_buffer(self, world: int) -> int:
        """How many batches each of `world` ranks draws from a buffer before the next."""
        average = sum(map(self.windows, range(len(self.frames)))) / len(self.frames)
        drawn = self.passes * average * min(self.buffer_size, len(self.frames))
        return max(1, round(drawn / (self.batch_size * world)))

    def members(self, buffer: int) -> tuple[int, ...]:
        """The trajectories in a buffer, each once, in ascending order."""
        total = len(self.frames)
        if total <= self.buffer_size:
            return tuple(range(total))
        places = range(buffer * self.buffer_size, (buffer + 1) * self.buffer_size)
        chosen = {int(_shuffle(total, self.seed, _TRAJECTORIES, p // total)[p % total]) for p in places}
        return tuple(sorted(chosen))

    def batch(self, index: int, rank: int, world: int) -> list[tuple[int, int]]:
        """The windows of a batch, each as (trajectory, first frame)."""
        per_buffer = self.batches_per_buffer(world)
        buffer, turn = divmod(index, per_buffer)
        members = self.members(buffer)
        ends = np.cumsum([self.windows(trajectory) for trajectory in members])
        total = int(ends[-1])
        first = (turn * world + rank) * self.batch_size
        places = range(first, first + self.batch_size)
        drawn = [int(_shuffle(total, self.seed, _WINDOWS, buffer, p // total)[p % total]) for p in places]
        owners = np.searchsorted(ends, drawn, side="right").tolist()
        return [
            (members[owner], window - int(ends[owner]) + self.windows(members[owner]))
            for owner, window in zip(owners, drawn, strict=True)
        ]


@lru_cache(maxsize=8)
def _shuffle(total: int, *stream: int) -> np.ndarray:
    """The numbers below `total` in an order that depends on the stream alone."""
    order = np.random.default_rng(stream).permutation(total)
    order.flags.writeable = False
    return order


class Motion:
    """Draws windows in proportion to the distance that their particles travel, on average.

    Args:
        held: Recordings by trajectory.
        length: Frames of a window.
    """

    def __init__(self, held: Mapping[int, Recording], length: int) -> None:
        travelled = {index: _travelled(recording, length) for index, recording in held.items()}
        self.windows = [(index, start) for index, distance in travelled.items() for start in range(len(distance))]
        self.cumulative = np.cumsum(np.concatenate(list(travelled.values())))

    def draw(self, rng: np.random.Generator) -> tuple[int, int]:
        """A window as (trajectory, first frame); any if nothing moves anywhere."""
        place = rng.random() * self.cumulative[-1]
        return self.windows[min(int(np.searchsorted(self.cumulative, place, side="right")), len(self.windows) - 1)]


def _travelled(recording: Recording, length: int) -> np.ndarray:
    """Mean distance that a particle travels within each window of `length` frames, (windows,)."""
    frames = recording.frames.numpy()
    speed = np.linalg.norm(np.diff(frames, axis=0), axis=-1).mean(axis=-1, dtype=np.float64)
    total = np.concatenate([[0.0], np.cumsum(speed)])
    return np.asarray(total[length - 1 :] - total[: len(total) - length + 1])


class TrajectoryBuffer:
    """Batches of training windows, without end, from trajectories held in memory.

    While one buffer is used, a thread reads the next: up to twice `plan.buffer_size` trajectories are in memory.

    Args:
        recordings: The trajectories.
        plan: Which windows make up which batch.

    Raises:
        DataError: if a trajectory is shorter than a window.
    """

    def __init__(self, recordings: Recordings, plan: WindowPlan) -> None:
        recordings.require_frames(plan.length, f"a training window of {plan.length - 2} frames to predict")
        self.recordings, self.plan = recordings, plan

    def batches(self, start: int = 0, rank: int = 0, world: int = 1) -> Iterator[Window]:
        """The batches from number `start` on, for one of `world` ranks.

        Raises:
            DataError: if a trajectory cannot be read or does not fit the scene.
        """
        per_buffer = self.plan.batches_per_buffer(world)
        with _reader() as reader:
            held = self._load(start // per_buffer, {})
            for buffer in count(start // per_buffer):
                motion = Motion(held, self.plan.length) if self.plan.emphasis else None
                upcoming: Future[dict[int, Recording]] = reader.submit(self._load, buffer + 1, held)
                for index in range(max(start, buffer * per_buffer), (buffer + 1) * per_buffer):
                    drawn = self.plan.batch(index, rank, world)
                    yield self._window(self._emphasised(drawn, motion, index, rank) if motion else drawn, held)
                held = upcoming.result()

    def _load(self, buffer: int, held: dict[int, Recording]) -> dict[int, Recording]:
        members = self.plan.members(buffer)
        return {index: held[index] if index in held else self.recordings[index] for index in members}

    def _emphasised(self, drawn: list[tuple[int, int]], motion: Motion, index: int, rank: int) -> list[tuple[int, int]]:
        """The windows drawn, some of them replaced by others that were drawn in proportion to motion."""
        rng = np.random.default_rng((self.plan.seed, _MOTION, index, rank))
        replaced = rng.random(len(drawn)) < self.plan.emphasis
        return [motion.draw(rng) if swap else window for swap, window in zip(replaced, drawn, strict=True)]

    def _window(self, drawn: list[tuple[int, int]], held: dict[int, Recording]) -> Window:
        trajectories, starts = zip(*drawn, strict=True)
        chosen = [held[trajectory] for trajectory in trajectories]
        return collate(chosen, starts, self.plan.length, self.recordings.scene)


@contextmanager
def _reader() -> Iterator[ThreadPoolExecutor]:
    """One thread that is left to finish by itself when nobody wants its result any more."""
    reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="trajectory-buffer")
    try:
        yield reader
    finally:
        reader.shutdown(wait=False, cancel_futures=True)
