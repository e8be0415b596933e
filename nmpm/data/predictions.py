"""Predictions as trajectories in the native layout, which bring their scene's facts along as attributes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nmpm._support import __version__
from nmpm.data.families import FAMILIES
from nmpm.data.format import TRUTH, Metadata, Trajectory
from nmpm.data.metadata import JsonKeys, parse_json, scene_metadata
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Scene

if TYPE_CHECKING:
    from torch import Tensor

    from nmpm.particles import Particles

DESCRIPTION = ("scene", "particle_types", "static_types", "prescribed_types")
"""Names of these attributes."""


def description(trajectory: Trajectory, metadata: Metadata, particle_volume: float) -> dict[str, Any]:
    """The attributes `scene`, `particle_types`, in JSON, and ids of types of a trajectory of a dataset."""
    types = np.unique(trajectory.particle_type).tolist()
    varies = "gravity" in trajectory.attributes
    scene = metadata.scene(types, particle_volume=particle_volume, gravity_varies=varies)
    prescribed = np.array(sorted(metadata.prescribed_types), dtype=np.int64)
    return ({"prescribed_types": prescribed} if len(prescribed) else {}) | {
        "scene": json.dumps(scene.to_dict()),
        "particle_types": json.dumps(metadata.particle_types),
        "static_types": np.array(sorted(metadata.static_types), dtype=np.int64),
    }


def read_description(attributes: Mapping[str, Any], path: Path, frames: int) -> tuple[Scene, Metadata]:
    """The scene of trajectories with a description, and the metadata of a dataset of them, of so many frames.

    Raises:
        DataError: naming the file, if an attribute is missing or wrong.
    """
    texts = {key: attributes.get(key) for key in ("scene", "particle_types")}
    if wrong := [key for key, text in texts.items() if not isinstance(text, str)]:
        raise DataError(f"{path}: the attribute {wrong[0]} of a prediction should be a text, in JSON.")
    plain, names = (parse_json(str(text), f"{path}, {key}") for key, text in texts.items())
    ids = {
        "static_types": np.asarray(attributes.get("static_types")).tolist(),
        "prescribed_types": np.asarray(attributes.get("prescribed_types", [])).tolist(),
    }
    keys = JsonKeys(path, {"particle_types": names} | ids)
    try:
        scene = Scene.from_dict(plain)
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from error
    static, prescribed = (keys.take(key) for key in ids)
    metadata = scene_metadata(scene, keys.take("particle_types"), None)
    # A description declares no inputs of models.
    return scene, replace(
        metadata, sequence_length=frames - 1, static_types=static, prescribed_types=prescribed, fields=()
    )


BOUNDARY = 3  # DeepMind's id of particles that do not move
MOVING_WALL = 2  # LagrangeBench's id of those that move as prescribed


def predicted_trajectory(
    scene: Scene,
    state: Particles,
    predicted: Tensor,
    model: str,
    index: int = 0,
    fields: Mapping[str, Tensor] | None = None,
    truth: Tensor | None = None,
    real: Tensor | None = None,
    obstacle_frames: Tensor | None = None,
) -> Trajectory:
    """One scene of a batch: the two frames that the rollout started from, then the prediction.

    Args:
        scene: The facts of the scenes; stored beside the positions.
        state: The states that the rollouts started from.
        predicted: (B, T, N, D) positions in domain length, NaN where a particle is not there.
        model: What predicted, in words.
        index: Which scene of the batch.
        fields: (B, T, N) predicted fields by name; stored as further datasets (T + 2, N), NaN for obstacles. The first
            two frames have the state's values, the first predicted ones where the state lacks them.
        truth: (B, T', N, D) recorded positions from the first of these two frames on, in domain length; stored as the
            dataset `truth`, which `nmpm view` and `nmpm render` show beside the prediction.
        real: (B, N) bool, which particles are written; those of the states when left out.
        obstacle_frames: (B, T'', M, D) positions of obstacles that move, from the first of these two frames on; in
            later frames they are where they were last.

    Raises:
        DataError: if the state has bodies, which no file can hold as such.
    """
    import torch  # (files of predictions are read without it)

    if state.obstacle_share is not None:
        raise DataError(
            "The state has obstacles as bodies, of which a file could hold no shapes: fill them with particles,"
            " state(…, obstacle=body.particles(spacing)), and predict again."
        )
    real = (state.mask if real is None else real)[index]
    start = torch.stack([state.position[index] - state.velocity[index], state.position[index]])
    start = start.where(state.mask[index].unsqueeze(-1), torch.nan)
    moves = obstacle_frames is not None
    obstacles = state.obstacle.unsqueeze(1) if obstacle_frames is None else obstacle_frames
    obstacle = obstacles[index][:, state.obstacle_mask[index]].cpu().numpy()
    position = _with_obstacle(torch.cat([start, predicted[index]])[:, real], obstacle)
    # DeepMind's ids; beyond 100 for materials that it does not have.
    ids = {name: number for number, name in FAMILIES["deepmind"].types.items()}
    types = {ids.get(name, 100 + number): name for number, name in enumerate(scene.materials)}
    moving = np.array(list(types), dtype=np.int64)[state.material[index, real].cpu().numpy()]
    attributes: dict[str, Any] = {
        "generator": f"nmpm {__version__}, predicted by {model}",
        "scene": json.dumps(scene.to_dict()),
        "particle_types": json.dumps({**types, BOUNDARY: "boundary"} | ({MOVING_WALL: "moving wall"} if moves else {})),
        "static_types": np.array([BOUNDARY]),
    }
    if moves:
        attributes["prescribed_types"] = np.array([MOVING_WALL])
    if scene.gravity_varies:
        attributes["gravity"] = (state.gravity[index].double() / scene.dt**2).cpu().numpy()
    particle_type = np.concatenate([moving, np.full(obstacle.shape[1], MOVING_WALL if moves else BOUNDARY)])
    stored = {
        name: _field_frames(state.fields.get(name, values[:, 0])[index], values[index], real, obstacle.shape[1])
        for name, values in (fields or {}).items()
    }
    if truth is not None:
        stored[TRUTH] = _with_obstacle(truth[index][:, real], obstacle)
    return Trajectory(position, particle_type, attributes, stored)


def _with_obstacle(moving: Tensor, obstacle: np.ndarray) -> np.ndarray:
    """(T, N + M, D) positions: those of the particles, then those of the obstacle (F, M, D), which then stays."""
    frames = np.minimum(np.arange(len(moving)), len(obstacle) - 1)
    return np.concatenate([moving.cpu().numpy(), obstacle[frames]], axis=1)


def _field_frames(start: Tensor, predicted: Tensor, real: Tensor, obstacles: int) -> np.ndarray:
    """(T + 2, N + M) values of a scene: those of the start (N,) or (1,) twice, then (T, N) predicted ones."""
    import torch

    frames = torch.cat([start.expand(2, predicted.shape[1]), predicted])[:, real].cpu().numpy()
    return np.pad(frames.astype(np.float32), ((0, 0), (0, obstacles)), constant_values=np.nan)
