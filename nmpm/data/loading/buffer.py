"""Training windows drawn from a few trajectories at a time.

A `WindowPlan` says in advance which windows make up which batch. A buffer holds the trajectories of the next batches
in one padded tensor, so that a batch is one gather; a thread reads the trajectories after them in the meantime.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import count, groupby
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from nmpm._support.threads import Task
from nmpm.data.loading.padded_batch import PaddedRecordings, displacements, overlap
from nmpm.data.loading.presence import first_frames
from nmpm.data.loading.recording import Recording
from nmpm.data.loading.window_plan import Drawn, WindowPlan
from nmpm.particles import Window
from nmpm.scene import Reading, Scene


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
    speed = _mean_over_present(np.sqrt(sum(squares)), recording.present)  # (`np.linalg.norm` takes four times as long)
    total = np.concatenate([[0.0], np.cumsum(speed)])
    return np.asarray(total[length - 1 :] - total[: len(total) - length + 1])


def _mean_over_present(speed: np.ndarray, present: Tensor | None) -> np.ndarray:
    """(T - 1,) mean of the (T - 1, N) speeds of those particles that are there before and after; 0 of none."""
    if present is None:
        return np.asarray(speed.mean(axis=-1, dtype=np.float64))
    there = (present[1:] & present[:-1]).numpy()
    return np.asarray((speed * there).sum(axis=-1, dtype=np.float64) / np.maximum(there.sum(axis=-1), 1))


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
