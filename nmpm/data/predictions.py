"""Predictions as trajectories in the native format, with all that is needed to draw or reuse them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.version import __version__
from nmpm.data.format import TRUTH, Trajectory
from nmpm.data.metadata import FAMILIES
from nmpm.errors import DataError
from nmpm.particles import Particles
from nmpm.scene import Scene

BOUNDARY = 3  # DeepMind's id of particles that do not move


def predicted_trajectory(
    scene: Scene,
    state: Particles,
    predicted: Tensor,
    model: str,
    index: int = 0,
    fields: Mapping[str, Tensor] | None = None,
    truth: Tensor | None = None,
) -> Trajectory:
    """One scene of a batch: the two frames that the rollout started from, then the prediction.

    Args:
        scene: The facts of the scenes; stored beside the positions.
        state: The states that the rollouts started from.
        predicted: (B, T, N, D) positions in domain length.
        model: What predicted, in words.
        index: Which scene of the batch.
        fields: (B, T, N) predicted fields by name; stored as further datasets (T + 2, N), NaN for obstacles. The first
            two frames have the state's values, the first predicted ones where the state lacks them.
        truth: (B, T', N, D) recorded positions from the first of these two frames on, in domain length; stored as the
            dataset `truth`, which `nmpm view` and `nmpm render` show beside the prediction.

    Raises:
        DataError: if the state has bodies, which no file can hold as such.
    """
    if state.obstacle_share is not None:
        raise DataError(
            "The state has obstacles as bodies, of which a file could hold no shapes: fill them with particles,"
            " state(…, obstacle=body.particles(spacing)), and predict again."
        )
    real = state.mask[index]
    start = torch.stack([state.position[index] - state.velocity[index], state.position[index]])
    obstacle = state.obstacle[index, state.obstacle_mask[index]].cpu().numpy()
    position = _with_obstacle(torch.cat([start, predicted[index]])[:, real], obstacle)
    # DeepMind's ids; beyond 100 for materials that it does not have.
    ids = {name: number for number, name in FAMILIES["deepmind"].types.items()}
    types = {ids.get(name, 100 + number): name for number, name in enumerate(scene.materials)}
    moving = np.array(list(types), dtype=np.int64)[state.material[index, real].cpu().numpy()]
    attributes: dict[str, Any] = {
        "generator": f"nmpm {__version__}, predicted by {model}",
        "scene": json.dumps(scene.to_dict()),
        "particle_types": json.dumps({**types, BOUNDARY: "boundary"}),
        "static_types": np.array([BOUNDARY]),
    }
    if scene.gravity_varies:
        attributes["gravity"] = (state.gravity[index].double() / scene.dt**2).cpu().numpy()
    particle_type = np.concatenate([moving, np.full(len(obstacle), BOUNDARY)])
    stored = {
        name: _field_frames(state.fields.get(name, values[:, 0])[index], values[index], real, len(obstacle))
        for name, values in (fields or {}).items()
    }
    if truth is not None:
        stored[TRUTH] = _with_obstacle(truth[index][:, real], obstacle)
    return Trajectory(position, particle_type, attributes, stored)


def _with_obstacle(moving: Tensor, obstacle: np.ndarray) -> np.ndarray:
    """(T, N + M, D) positions: those of the particles that move, then those of the obstacle (M, D)."""
    resting = np.broadcast_to(obstacle, (len(moving), *obstacle.shape))
    return np.concatenate([moving.cpu().numpy(), resting], axis=1)


def _field_frames(start: Tensor, predicted: Tensor, real: Tensor, obstacles: int) -> np.ndarray:
    """(T + 2, N + M) values of a scene: those of the start (N,) or (1,) twice, then (T, N) predicted ones."""
    frames = torch.cat([start.expand(2, predicted.shape[1]), predicted])[:, real].cpu().numpy()
    return np.pad(frames.astype(np.float32), ((0, 0), (0, obstacles)), constant_values=np.nan)
