"""Training windows drawn from a few trajectories at a time.

Which windows make up which batch is planned ahead (`plan.py`). A buffer holds the trajectories that the next batches
come from, side by side, so that a batch is one gather; the trajectories after them are read meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, groupby
from typing import Protocol

import numpy as np
import torch

from nmpm.data.loading.background import run_in_thread
from nmpm.data.loading.padded_batch import PaddedRecordings
from nmpm.data.loading.recording import Recording
from nmpm.data.loading.window_plan import MOTION, WindowPlan
from nmpm.particles import Window
from nmpm.scene import Scene


class RecordingProvider(Protocol):
    """Where a buffer takes its trajectories from."""

    scene: Scene

    @property
    def max_bytes(self) -> int:
        """Size of the positions of the largest trajectory."""

    def load(self, indices: Sequence[int]) -> list[Recording]:
        """Several trajectories, by number."""

    def require_frames(self, frames: int, purpose: str) -> None:
        """Makes sure that every trajectory is long enough."""


class MotionSampler:
    """Draws windows in proportion to the distance that their particles travel, on average.

    Args:
        held: SplitRecordings by trajectory.
        length: Frames of a window.
    """

    def __init__(self, held: Mapping[int, Recording], length: int) -> None:
        travelled = {index: _distances_travelled(recording, length) for index, recording in held.items()}
        self.windows = [(index, start) for index, distance in travelled.items() for start in range(len(distance))]
        self.cumulative = np.cumsum(np.concatenate(list(travelled.values())))

    def window_at(self, share: float) -> tuple[int, int]:
        """The window, as (trajectory, first frame), at a share in [0, 1) of all motion; any if nothing moves."""
        place = share * self.cumulative[-1]
        return self.windows[min(int(np.searchsorted(self.cumulative, place, side="right")), len(self.windows) - 1)]


def _distances_travelled(recording: Recording, length: int) -> np.ndarray:
    """Mean distance that a particle travels within each window of `length` frames, (windows,)."""
    frames = recording.frames.numpy()
    speed = np.linalg.norm(np.diff(frames, axis=0), axis=-1).mean(axis=-1, dtype=np.float64)
    total = np.concatenate([[0.0], np.cumsum(speed)])
    return np.asarray(total[length - 1 :] - total[: len(total) - length + 1])


@dataclass(frozen=True)
class _BufferContents:
    """The trajectories of one buffer: where each stands on the padded, and how their windows move."""

    padded: PaddedRecordings
    recordings: Mapping[int, Recording]
    motion: MotionSampler | None

    def window(self, drawn: Sequence[tuple[int, int]], length: int) -> Window:
        place = {trajectory: row for row, trajectory in enumerate(self.recordings)}
        trajectories, starts = zip(*drawn, strict=True)
        return self.padded.window([place[trajectory] for trajectory in trajectories], starts, length)


class TrajectoryBuffer:
    """Batches of training windows, without end, from trajectories held in memory.

    While one buffer is used, a thread reads the next: up to three times `plan.buffer_size` trajectories are in memory,
    whatever the size of the dataset.

    Args:
        source: The trajectories.
        plan: Which windows make up which batch.
        device: Where the trajectories are held and windows are gathered.

    Raises:
        DataError: if a trajectory is shorter than a window.
    """

    def __init__(self, source: RecordingProvider, plan: WindowPlan, device: torch.device | None = None) -> None:
        source.require_frames(plan.length, f"a training window of {plan.length - 2} frames to predict")
        self.source, self.plan, self.device = source, plan, device or torch.device("cpu")

    def batches(self, start: int = 0, rank: int = 0, world: int = 1) -> Iterator[Window]:
        """The batches from number `start` on, for one of `world` ranks.

        Raises:
            DataError: if a trajectory cannot be read or does not fit the scene.
        """
        plan = self.plan
        held = self._load_contents(plan.members(plan.locate(start, world)[0], rank, world), None)
        for buffer, indices in groupby(count(start), key=lambda index: plan.locate(index, world)[0]):
            upcoming = run_in_thread(self._load_contents, plan.members(buffer + 1, rank, world), held)
            for index in indices:
                drawn = self._apply_emphasis(plan.batch(index, rank, world), held.motion, index, rank, world)
                yield held.window(drawn, plan.length)
            held = upcoming.result()

    def _load_contents(self, members: Sequence[int], held: _BufferContents | None) -> _BufferContents:
        known = held.recordings if held is not None else {}
        if held is not None and list(members) == list(known):
            return held
        missing = [index for index in members if index not in known]
        found = dict(zip(missing, self.source.load(missing), strict=True))
        loaded = [known[index] if index in known else found[index] for index in members]
        padded = PaddedRecordings.stack(loaded, self.source.scene)
        # Views: what was loaded itself is let go.
        recordings = {index: padded.recording(row, loaded[row]) for row, index in enumerate(members)}
        motion = MotionSampler(recordings, self.plan.length) if self.plan.emphasis else None
        return _BufferContents(padded.to(self.device), recordings, motion)

    def _apply_emphasis(
        self, drawn: list[tuple[int, int]], motion: MotionSampler | None, index: int, rank: int, world: int
    ) -> list[tuple[int, int]]:
        """The windows drawn, some of them replaced by others that were drawn in proportion to motion.

        The chances are drawn for the batches of all ranks, as one process with so large a batch would, and each rank
        takes its part of them.
        """
        if motion is None:
            return drawn
        rng = np.random.default_rng((self.plan.seed, MOTION, index, 0))
        replaced = rng.random(len(drawn) * world) < self.plan.emphasis
        first = rank * len(drawn)
        mine = replaced[first : first + len(drawn)]
        before = int(replaced[:first].sum())
        shares = iter(rng.random(before + int(mine.sum()))[before:])
        return [motion.window_at(next(shares)) if swap else window for swap, window in zip(mine, drawn, strict=True)]
