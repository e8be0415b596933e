"""Batches of whole trajectories for validation, test and prediction, distributed over the ranks."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import torch

from nmpm.data.loading.padded_batch import collate, pin_for
from nmpm.data.loading.recording import SplitRecordings
from nmpm.particles import Window


class EvaluationLoader:
    """Whole trajectories in batches of equal length; each trajectory goes to exactly one rank.

    Similar numbers of particles share a batch, so that few are padded much. `batches` holds the indices of each
    batch's trajectories. Trajectories with fewer than 3 frames are left out, with a warning that counts them. A
    rank without any has one batch of none, so that it takes part in all collectives.

    Args:
        recordings: The trajectories.
        batch_size: Trajectories per batch, at most.
        limit: Only the first `limit` trajectories; all when None.
        rank, world: Index of this process, and the number of processes.
        device: Where the batches are used; those for a GPU are in pinned memory.

    Raises:
        DataError: if all trajectories have fewer than 3 frames, so that there is nothing to predict.
    """

    def __init__(
        self,
        recordings: SplitRecordings,
        batch_size: int,
        limit: int | None = None,
        rank: int = 0,
        world: int = 1,
        device: torch.device | None = None,
    ) -> None:
        self.recordings, self.device = recordings, device or torch.device("cpu")
        self._batch_size, self._rank, self._world = batch_size, rank, world
        self._indices = recordings.with_frames(3, "an evaluation").indices
        self.restrict(limit)

    def restrict(self, limit: int | None) -> None:
        """Use only the first `limit` trajectories from now on; all when None."""
        split = self.recordings.split
        order = sorted(self._indices[:limit], key=split.frames)[self._rank :: self._world]
        batches: list[tuple[int, ...]] = []
        for _, equally_long in itertools.groupby(order, key=split.frames):
            by_size, size = sorted(equally_long, key=split.particles), self._batch_size
            batches += sorted(tuple(sorted(by_size[i : i + size])) for i in range(0, len(by_size), size))
        self.batches = tuple(batches) or ((),)

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[Window]:
        return pin_for(self.device, map(self._read, self.batches))

    def _read(self, indices: Sequence[int]) -> Window:
        read = collate([self.recordings.at(index) for index in indices or self._indices[:1]], self.recordings.reading)
        return read.scenes(slice(len(indices)))
