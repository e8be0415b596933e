"""Trajectories for Lightning: windows to train on, whole trajectories to evaluate on."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningDataModule

from nmpm.data.buffer import TrajectoryBuffer, WindowPlan
from nmpm.data.format import Metadata, Split, read_metadata, split_paths
from nmpm.data.recording import Recordings, collate
from nmpm.data.scenes import infer_scene
from nmpm.errors import ConfigError, DataError
from nmpm.particles import Window
from nmpm.scene import Boundary, Scene


class TrajectoryDataModule(LightningDataModule):
    """Recorded or simulated trajectories, as `Window` batches.

    Training batches come without end (give the Trainer `max_steps`), each of windows of horizon + 2 frames, and go on
    where training stopped when a checkpoint is resumed. Validation, test and prediction batches hold whole
    trajectories, each once over all ranks; prediction uses the test split.

    Args:
        path: Folder of a dataset in the native layout.
        name: Embedded dataset, simulated on first use; either this or `path`.
        horizon: Frames to predict in a training window: frames per bundle times bundles unrolled.
        batch_size: Training windows per batch and rank.
        buffer_size: Training trajectories held in memory at a time; twice as many while the next are read.
        passes: How often the windows of a buffer are seen, on average, before the next buffer.
        emphasis: Share of the training windows that is drawn in proportion to the motion in them, in [0, 1]; the rest
            is drawn evenly. Worth it where recordings end in long rest.
        seed: Order of the training windows.
        family: What the type ids in `path` mean where its metadata does not say: "deepmind" or "lagrangebench".
        gravity: Acceleration in length/s² per axis, instead of that in the metadata of `path`.
        boundary: "wall" or "periodic" per axis, instead of what the metadata of `path` says.
        limit_eval: Validate on the first so many trajectories only.
        eval_batch_size: Trajectories per evaluation batch, of equal length each.
        generate: Options for the simulation of `name`, such as the number of trajectories.

    Raises:
        ConfigError: if not exactly one of `path` and `name` is given, or a number is not positive.
    """

    def __init__(
        self,
        path: str | None = None,
        name: str | None = None,
        horizon: int = 16,
        batch_size: int = 16,
        buffer_size: int = 16,
        passes: float = 4,
        emphasis: float = 0.0,
        seed: int = 0,
        family: str | None = None,
        gravity: list[float] | None = None,
        boundary: list[Boundary] | None = None,
        limit_eval: int | None = None,
        eval_batch_size: int = 8,
        generate: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        _check_source(path, name, family=family, gravity=gravity, boundary=boundary, generate=generate)
        for key, value in (("horizon", horizon), ("eval_batch_size", eval_batch_size), ("limit_eval", limit_eval)):
            if value is not None and value < 1:
                raise ConfigError(f"{key} = {value} must be at least 1.")
        self.path, self.name, self.generate = path, name, dict(generate or {})
        self.horizon, self.batch_size, self.seed = horizon, batch_size, seed
        self.buffer_size, self.passes, self.emphasis = buffer_size, passes, emphasis
        self.family, self.gravity, self.boundary = family, gravity, boundary
        self.limit_eval, self.eval_batch_size = limit_eval, eval_batch_size

    def __str__(self) -> str:
        # Lightning's own would go through the endless training batches.
        source = f"path={self.path!r}" if self.name is None else f"name={self.name!r}"
        return f"{type(self).__name__}({source}, horizon={self.horizon}, batch_size={self.batch_size})"

    @cached_property
    def scene(self) -> Scene:
        """The scene of the dataset; an embedded one need not have been simulated for it.

        Raises:
            DataError: if the files at `path` are missing or wrong.
            ConfigError: if there is no such embedded dataset.
        """
        if self.name is not None:
            from nmpm.data import catalog

            return catalog.scene(self.name)
        return infer_scene(self.folder, self.family, self.gravity, self.boundary)

    @cached_property
    def folder(self) -> Path:
        """Where the dataset's files are; an embedded one is simulated if it has not been yet.

        Raises:
            ConfigError: if `generate` holds an unknown option.
        """
        if self.name is not None:
            from nmpm.data import catalog

            try:
                inspect.signature(catalog.ensure).bind(self.name, **self.generate)
            except TypeError as error:
                raise ConfigError(f"generate = {self.generate}: {error}.") from error
            return catalog.ensure(self.name, **self.generate)
        return Path(self.path or "")

    @cached_property
    def metadata(self) -> Metadata:
        """The dataset's metadata."""
        return read_metadata(self.folder, self.family)

    @property
    def description(self) -> str:
        """What the data are, in words: simulated data are named so."""
        return f"{self.name}, simulated by nmpm" if self.name is not None else Path(self.path or "").name

    def split(self, name: str) -> Split:
        """The file of a split: "train", "valid" or "test".

        Raises:
            DataError: if the dataset has no such split, or its file is damaged.
        """
        paths = split_paths(self.folder)
        if name not in paths:
            raise DataError(f"{self.folder}: no {name}.h5 there (found: {', '.join(paths) or 'no split at all'}).")
        return Split(paths[name])

    def recordings(self, name: str) -> Recordings:
        """The trajectories of a split as tensors."""
        return Recordings(self.split(name), self.metadata, self.scene)

    def prepare_data(self) -> None:
        """Simulates an embedded dataset on first use, in one process."""
        _ = self.folder

    def train_dataloader(self) -> TrainingLoader:
        """Endless batches of training windows."""
        recordings = self.recordings("train")
        plan = WindowPlan(
            frames=tuple(map(recordings.split.frames, range(len(recordings)))),
            length=self.horizon + 2,
            batch_size=self.batch_size,
            buffer_size=self.buffer_size,
            passes=self.passes,
            seed=self.seed,
            emphasis=self.emphasis,
        )
        return TrainingLoader(TrajectoryBuffer(recordings, plan), self)

    def val_dataloader(self) -> EvaluationLoader:
        """Whole trajectories of the valid split, or the first `limit_eval` of them."""
        return self._evaluation("valid", self.limit_eval)

    def test_dataloader(self) -> EvaluationLoader:
        """Whole trajectories of the test split."""
        return self._evaluation("test")

    def predict_dataloader(self) -> EvaluationLoader:
        """Whole trajectories of the test split."""
        return self._evaluation("test")

    def _evaluation(self, name: str, limit: int | None = None) -> EvaluationLoader:
        rank, world = self.ranks
        return EvaluationLoader(self.recordings(name), self.eval_batch_size, limit, rank, world)

    @property
    def ranks(self) -> tuple[int, int]:
        """This process's number, and how many there are."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer is not None else (0, 1)

    @property
    def batches_seen(self) -> int:
        """How many training batches this rank has finished, over all epochs and interruptions."""
        if self.trainer is None:
            return 0
        # Only `processed` is right in every checkpoint: `ready` counts a batch that was interrupted, `completed`
        # misses the one after which the checkpoint was written.
        total = self.trainer.fit_loop.epoch_loop.batch_progress.total
        return int(total.processed)  # type: ignore[attr-defined]


class TrainingLoader:
    """The training batches from where training stands, each time it is iterated.

    Args:
        buffer: Gives the batches.
        owner: Knows where training stands.
    """

    def __init__(self, buffer: TrajectoryBuffer, owner: TrajectoryDataModule) -> None:
        self.buffer, self.owner = buffer, owner

    def __iter__(self) -> Iterator[Window]:
        return self.buffer.batches(self.owner.batches_seen, *self.owner.ranks)

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the Trainer's own progress says where to go on. That this exists tells Lightning so."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Has nothing to restore."""


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
        self, recordings: Recordings, batch_size: int, limit: int | None = None, rank: int = 0, world: int = 1
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
        return collate(chosen, [0] * len(batch), len(chosen[0].frames), self.recordings.scene)


def _check_source(path: str | None, name: str | None, **options: Any) -> None:
    if (path is None) == (name is None):
        raise ConfigError(
            f"Give either a dataset's `path` or the `name` of an embedded one; got path = {path}, name = {name}."
        )
    belongs = {"family": "path", "gravity": "path", "boundary": "path", "generate": "name"}
    given = "path" if path is not None else "name"
    wrong = [key for key, value in options.items() if value is not None and belongs[key] != given]
    if wrong:
        raise ConfigError(f"{', '.join(wrong)} cannot be combined with `{given}`; leave it out.")
