"""Which training windows make up which batch.

The trajectories of a dataset, shuffled again and again, form one endless row; buffer b is its b-th slice of
`buffer_size`. The windows of a buffer, shuffled again and again, form another endless row; batch after batch is cut
from it, dealt to the ranks in turn, until `passes` times as many windows as an average buffer holds have been drawn.
So every window is as likely as any other, no rank sees what another sees within a pass, and batch i of a rank is a
pure function of the seed and the data: training that stopped goes on with the batch it would have seen. All ranks'
batches together are that of one process with as large a batch; where their size changes, training goes on in the same
row of windows (`WindowPlan.after`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np

from nmpm.errors import ConfigError

_TRAJECTORIES, _WINDOWS, MOTION = 0, 1, 2  # separate the streams of random numbers


@dataclass(frozen=True)
class PlanStart:
    """Where batches of a size begin.

    Args:
        batch: Number of the first of them.
        buffer: The buffer that it is drawn from.
        drawn: How many windows of that buffer were drawn before.
    """

    batch: int = 0
    buffer: int = 0
    drawn: int = 0


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
        start: Where the batches of this size begin, if there were others before.

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
    start: PlanStart = PlanStart()

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

    def members(self, buffer: int, rank: int = 0, world: int = 1) -> tuple[int, ...]:  # noqa: ARG002
        """The trajectories in a buffer of a rank, each once, in ascending order; the same ones for all ranks."""
        total = len(self.frames)
        if total <= self.buffer_size:
            return tuple(range(total))
        places = range(buffer * self.buffer_size, (buffer + 1) * self.buffer_size)
        chosen = {int(_shuffle(total, self.seed, _TRAJECTORIES, p // total)[p % total]) for p in places}
        return tuple(sorted(chosen))

    def locate(self, index: int, world: int) -> tuple[int, int]:
        """The buffer that a batch is drawn from, and how many of its windows are drawn before."""
        stride, per_buffer = self._stride(world), self.batches_per_buffer(world)
        since = index - self.start.batch
        left = max(0, per_buffer - self.start.drawn // stride)
        if since < left:
            return self.start.buffer, self.start.drawn + since * stride
        buffers, turn = divmod(since - left, per_buffer)
        return self.start.buffer + 1 + buffers, turn * stride

    def batch(self, index: int, rank: int, world: int) -> list[tuple[int, int]]:
        """The windows of a batch, each as (trajectory, first frame)."""
        buffer, drawn = self.locate(index, world)
        members = self.members(buffer, rank, world)
        ends = np.cumsum([self.windows(trajectory) for trajectory in members])
        total = int(ends[-1])
        first = drawn + self._offset(rank)
        places = range(first, first + self.batch_size)
        chosen = [int(_shuffle(total, self.seed, _WINDOWS, buffer, p // total)[p % total]) for p in places]
        owners = np.searchsorted(ends, chosen, side="right").tolist()
        return [
            (members[owner], window - int(ends[owner]) + self.windows(members[owner]))
            for owner, window in zip(owners, chosen, strict=True)
        ]

    def resume_after(self, batches: int, batch_size: int, earlier: int, world: int) -> Self:
        """This plan, to be gone on with after batches of another size: with the first window that none of them had.

        Args:
            batches: Batches that each rank has had, from the first on.
            batch_size: Windows in each of those since `start`.
            earlier: Number of ranks that had them.
            world: Number of ranks from now on.
        """
        if batch_size * earlier == self.batch_size * world:
            return self
        if batches == self.start.batch:
            return self
        had = replace(self, batch_size=batch_size)
        buffer, drawn = had.locate(batches - 1, earlier)  # a buffer's rest, too small for those, may do for these
        return replace(self, start=PlanStart(batches, buffer, drawn + had._stride(earlier)))

    def _stride(self, world: int) -> int:
        """Windows of a buffer that one batch of every rank takes."""
        return self.batch_size * world

    def _offset(self, rank: int) -> int:
        """Batches are dealt to the ranks in turn."""
        return rank * self.batch_size


@dataclass(frozen=True)
class EndlessWindowPlan(WindowPlan):
    """Windows of trajectories without end, such as a simulator makes: every buffer of every rank has its own.

    Args:
        frames: Frames of each trajectory of a buffer, all equal.
    """

    def windows(self, trajectory: int) -> int:  # noqa: ARG002
        return self.frames[0] - self.length + 1

    def batches_per_buffer(self, world: int) -> int:  # noqa: ARG002
        return super().batches_per_buffer(1)

    def members(self, buffer: int, rank: int = 0, world: int = 1) -> tuple[int, ...]:
        first = (buffer * world + rank) * self.buffer_size
        return tuple(range(first, first + self.buffer_size))

    def resume_after(self, batches: int, batch_size: int, earlier: int, world: int) -> Self:
        """As for a plan with an end, but with the first buffer that no rank has begun."""
        if (batch_size, earlier) == (self.batch_size, world):
            return self
        buffer, drawn = replace(self, batch_size=batch_size).locate(batches, earlier)
        begun = (buffer + (drawn > 0)) * earlier
        return replace(self, start=PlanStart(batches, -(-begun // world)))

    def _stride(self, world: int) -> int:  # noqa: ARG002
        return self.batch_size

    def _offset(self, rank: int) -> int:  # noqa: ARG002
        return 0


@lru_cache(maxsize=8)
def _shuffle(total: int, *stream: int) -> np.ndarray:
    """The numbers below `total` in an order that depends on the stream alone."""
    order = np.random.default_rng(stream).permutation(total)
    order.flags.writeable = False
    return order
