"""Write the predictions of `nmpm predict`. Apart from `nmpm.data.predictions`, as Lightning takes seconds to import."""

from __future__ import annotations

import sys
from itertools import zip_longest
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import BasePredictionWriter

from nmpm._support.collectives import gather_to_rank0
from nmpm.data.format import Trajectory, write_split
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
        self._predicted: list[Trajectory] = []

    def write_on_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        prediction: Any,
        batch_indices: Any,  # noqa: ARG002
        batch: Window,
        batch_idx: int,  # noqa: ARG002
        dataloader_idx: int,  # noqa: ARG002
    ) -> None:
        scene: Scene = pl_module.emulator.scene  # type: ignore[union-attr,assignment]  # (an EmulatorModule)
        source = f"{trainer.ckpt_path or 'the model'}"
        fields = prediction.fields if isinstance(prediction, Rollout) else {}
        positions = prediction.position if isinstance(prediction, Rollout) else prediction
        for index in range(len(positions)):
            self._predicted.append(predicted_trajectory(scene, batch.initial, positions, source, index, fields))

    def on_predict_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        by_rank = gather_to_rank0(self._predicted)
        if trainer.is_global_zero:
            rounds = zip_longest(*by_rank)  # ranks take trajectories in turn, so the last round may be short
            ordered = [trajectory for turn in rounds for trajectory in turn if trajectory is not None]
            path = Path(trainer.default_root_dir) / "predictions.h5"
            write_split(path, ordered)
            sys.stdout.write(f"written to {path}; to draw them: nmpm render {path}\n")
        self._predicted = []
