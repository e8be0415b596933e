"""Predictions as trajectories in the native format, with all that is needed to draw or reuse them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import BasePredictionWriter
from torch import Tensor

from nmpm.data.families import FAMILIES
from nmpm.data.format import Trajectory, write_split
from nmpm.particles import Particles, Window
from nmpm.scene import Scene
from nmpm.version import __version__

BOUNDARY = 3  # DeepMind's id of particles that do not move


def predicted_trajectory(scene: Scene, state: Particles, predicted: Tensor, model: str, index: int = 0) -> Trajectory:
    """One scene of a batch: the two frames that the rollout started from, then the prediction.

    Args:
        scene: The facts of the scenes; stored beside the positions.
        state: The states that the rollouts started from.
        predicted: (B, T, N, D) positions in domain length.
        model: What predicted, in words.
        index: Which scene of the batch.
    """
    real = state.mask[index]
    start = torch.stack([state.position[index] - state.velocity[index], state.position[index]])
    position = torch.cat([start, predicted[index]])[:, real].cpu().numpy()
    obstacle = state.obstacle[index, state.obstacle_mask[index]].cpu().numpy()
    resting = np.broadcast_to(obstacle, (len(position), *obstacle.shape))
    types = _type_ids(scene)
    moving = np.array(list(types), dtype=np.int64)[state.material[index, real].cpu().numpy()]
    attributes = {
        "generator": f"nmpm {__version__}, predicted by {model}",
        "scene": json.dumps(scene.to_dict()),
        "particle_types": json.dumps({**types, BOUNDARY: "boundary"}),
        "static_types": np.array([BOUNDARY]),
    }
    ids = np.concatenate([moving, np.full(len(obstacle), BOUNDARY)])
    return Trajectory(np.concatenate([position, resting], axis=1), ids, attributes)


class PredictionWriter(BasePredictionWriter):
    """Writes what `nmpm predict` predicts to `predictions.h5` in the run's folder, a file per process if several."""

    def __init__(self) -> None:
        super().__init__(write_interval="batch")
        self._made: list[Trajectory] = []

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
        scene: Scene = pl_module.emulator.scene  # type: ignore[union-attr,assignment]
        source = f"{trainer.ckpt_path or 'the model'}"
        for index in range(len(prediction)):
            self._made.append(predicted_trajectory(scene, batch.initial, prediction, source, index))

    def on_predict_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        rank = f"_{trainer.global_rank}" if trainer.world_size > 1 else ""
        write_split(Path(trainer.default_root_dir) / f"predictions{rank}.h5", self._made)
        self._made = []


def _type_ids(scene: Scene) -> dict[int, str]:
    """DeepMind's id for each of the scene's materials, in order; beyond 100 for materials that it does not have."""
    ids = {name: number for number, name in FAMILIES["deepmind"].types.items()}
    return {ids.get(name, 100 + index): name for index, name in enumerate(scene.materials)}
