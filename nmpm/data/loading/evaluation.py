"""Whole trajectories to evaluate on, in batches, dealt to the processes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import SplitRecordings
from nmpm.errors import ConfigError
from nmpm.particles import Window


class EvaluationLoader:
    """Whole trajectories in batches of equal length, dealt to the ranks in turn.

    Args:
        recordings: The trajectories.
        batch_size: At most so many in a batch.
        limit: Only the first so many; all when None.
        rank: This process's number.
        world: Number of processes.

    Raises:
        DataError: if a trajectory has nothing to predict, that is, fewer than 3 frames.
        ConfigError: if there are more processes than trajectories.
    """

    def __init__(
        self, recordings: SplitRecordings, batch_size: int, limit: int | None = None, rank: int = 0, world: int = 1
    ) -> None:
        self.recordings = recordings
        recordings.require_frames(3, "an evaluation")
        frames = recordings.split.frames
        order = sorted(range(len(recordings))[:limit], key=frames)
        if len(order) < world:
            # A rank without a batch would leave the others waiting for it.
            raise ConfigError(
                f"{recordings.split.path}: {len(order)} trajectories cannot be shared by {world} processes. Evaluate"
                " with fewer devices, or on more trajectories."
            )
        groups = (list(group) for _, group in itertools.groupby(order[rank::world], key=frames))
        self.batches: tuple[tuple[int, ...], ...] = tuple(
            tuple(group[first : first + batch_size]) for group in groups for first in range(0, len(group), batch_size)
        )

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[Window]:
        for batch in self.batches:
            yield self._window(batch)

    def _window(self, batch: Sequence[int]) -> Window:
        chosen = [self.recordings[index] for index in batch]
        return collate(chosen, self.recordings.scene)
