"""Training windows drawn from a few trajectories at a time.

The trajectories of a dataset, shuffled again and again, form one endless row; buffer b is its b-th slice of
`buffer_size`. The windows of a buffer, shuffled again and again, form another endless row; batch after batch is cut
from it, dealt to the ranks in turn, until `passes` times as many windows as an average buffer holds have been drawn.
So every window is as likely as any other, no rank sees what another sees within a pass, and batch i of a rank is a
pure function of the seed: training that stopped goes on with the batch it would have seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import count

import numpy as np

from nmpm.data.recording import Recording, Recordings, collate
from nmpm.errors import ConfigError
from nmpm.particles import Window

_TRAJECTORIES, _WINDOWS = 0, 1  # separate the streams of random numbers


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

    Raises:
        ConfigError: if a number is not positive.
    """

    frames: tuple[int, ...]
    length: int
    batch_size: int
    buffer_size: int
    passes: float
    seed: int

    def __post_init__(self) -> None:
        for name in ("batch_size", "buffer_size", "passes"):
            if getattr(self, name) <= 0:
                raise ConfigError(f"{name} = {getattr(self, name)} must be positive.")
        if self.seed < 0:
            raise ConfigError(f"seed = {self.seed} must not be negative.")

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
                upcoming: Future[dict[int, Recording]] = reader.submit(self._load, buffer + 1, held)
                for index in range(max(start, buffer * per_buffer), (buffer + 1) * per_buffer):
                    yield self._window(self.plan.batch(index, rank, world), held)
                held = upcoming.result()

    def _load(self, buffer: int, held: dict[int, Recording]) -> dict[int, Recording]:
        members = self.plan.members(buffer)
        return {index: held[index] if index in held else self.recordings[index] for index in members}

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
