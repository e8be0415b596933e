"""Write the predictions of `nmpm predict`. Apart from `nmpm.data.predictions`, as Lightning takes seconds to import."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import BasePredictionWriter

from nmpm._support.collectives import gather_to_rank0, rank_and_world_size
from nmpm.data.format import Trajectory, write_split
from nmpm.data.loading.evaluation import EvaluationLoader
from nmpm.data.predictions import predicted_trajectory
from nmpm.emulator import Rollout
from nmpm.particles import Window
from nmpm.scene import Scene


class PredictionWriter(BasePredictionWriter):
    """Writes what `nmpm predict` predicts to `predictions.h5` in the run's folder.

    Rank 0 writes the predictions of all ranks, in the order of the test split.
    """

    def __init__(self) -> None:
        super().__init__(write_interval="batch")
        self._predicted: dict[int, Trajectory] = {}

    def write_on_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        prediction: Any,
        batch_indices: Any,  # noqa: ARG002
        batch: Window,
        batch_idx: int,
        dataloader_idx: int,  # noqa: ARG002
    ) -> None:
        scene: Scene = pl_module.emulator.scene  # type: ignore[union-attr,assignment]  # (an EmulatorModule)
        source = f"{trainer.ckpt_path or 'the model'}"
        fields = prediction.fields if isinstance(prediction, Rollout) else {}
        positions = prediction.position if isinstance(prediction, Rollout) else prediction
        for row, index in enumerate(self._places(trainer.predict_dataloaders, batch_idx, len(positions))):
            self._predicted[index] = predicted_trajectory(scene, batch.initial, positions, source, row, fields)

    def _places(self, loader: object, batch_idx: int, count: int) -> Sequence[int]:
        """Where the trajectories of a batch belong in the file."""
        if isinstance(loader, EvaluationLoader):
            return loader.batches[batch_idx]
        rank, world = rank_and_world_size()  # of another loader: in the order of arrival, ranks in turn
        first = rank + world * len(self._predicted)
        return range(first, first + world * count, world)

    def on_predict_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        by_rank = gather_to_rank0(self._predicted)
        if trainer.is_global_zero:
            found = {index: trajectory for own in by_rank for index, trajectory in own.items()}
            ordered = [found[index] for index in sorted(found)]
            path = Path(trainer.default_root_dir) / "predictions.h5"
            write_split(path, ordered)
            sys.stdout.write(f"written to {path}; to draw them: nmpm render {path}\n")
        self._predicted = {}
