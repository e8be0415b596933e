"""States to start a rollout from: thrown blocks, and frames of recorded trajectories."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nmpm._support.messages import suggestion
from nmpm._support.numbers import check_whole
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.initial_states import thrown_blocks
from nmpm.data.loading.model_frames import model_velocity
from nmpm.data.statistics import displacements
from nmpm.data.volumes import relative_volumes
from nmpm.emulator.calibration import with_usual_gravity
from nmpm.errors import ConfigError, DataError
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.zoo.states import StateBuilder

if TYPE_CHECKING:
    from nmpm.zoo.pretrained import Pretrained

THROWN = 1000
"""Particles of thrown blocks, about, unless their number is given."""
_SAME_GRAVITY = 0.05
"""Share of the model's gravity by which that of data may differ, as it may be measured."""


def thrown_state(model: Pretrained, seed: int, count: int, blocks: int | None, gravity: Any) -> Particles:
    """Blocks of particles thrown into the scene's box, for a model; see `Pretrained.example`."""
    blocks = len(model.scene.materials) if blocks is None else blocks
    for name, value, least in (("seed", seed, 0), ("count", count, 1), ("blocks", blocks, 1)):
        check_whole(name, value, least)
    try:
        state = thrown_blocks(model.scene, count=count, blocks=blocks, seed=seed)
    except ValueError as error:
        raise ConfigError(f"{error} Use fewer particles or more blocks.") from error
    if gravity is None:
        return with_usual_gravity(model.emulator, state)
    builder = StateBuilder(model.emulator, state.position, state.position.dtype)
    return dataclasses.replace(state, gravity=builder.gravity(gravity))


def state_of(
    model: Pretrained, trajectory: Trajectory, frame: int = 1, materials: Mapping[str, str] | None = None
) -> Particles:
    """The state of a trajectory at a frame, for a model; see `Pretrained.start`."""
    metadata = _metadata(model, trajectory)
    frames = len(trajectory.position)
    if not 1 <= frame < frames:
        raise ConfigError(f"frame = {frame} must be 1 … {frames - 1}: velocities need the frame before it.")
    if metadata.dim != model.scene.dim:
        raise DataError(f"The trajectory has {metadata.dim} axes, the model {model.scene.dim}.")
    back = min(frame, max(1, round(model.scene.dt / metadata.dt)))
    steps = _steps(trajectory, metadata, frame, back)
    present, position = ~np.isnan(steps[1, :, 0]), trajectory.position[frame]
    types = trajectory.particle_type
    moving, obstacle = metadata.is_moving(types) & present, np.isin(types, list(metadata.obstacle_types)) & present
    if not moving.any():
        raise DataError(f"No particle that moves is there in frames {frame - back} and {frame} of the trajectory.")
    state = model.state(
        position[moving],
        velocity=_velocity(model, trajectory, metadata, steps[:, moving], back),
        material=_materials(model, metadata, types[moving], {**dict(model.scene.aliases), **(materials or {})}),
        obstacle=position[obstacle] if obstacle.any() else None,
        gravity=_gravity(model, trajectory, metadata),
        fields=_fields(model, trajectory, frame, moving),
        volume=relative_volumes(trajectory, moving),
    )
    if not model.scene.moving_obstacles or not obstacle.any():
        return state
    moved = torch.from_numpy(steps[1, obstacle] / (back * metadata.dt)).to(state.obstacle) * model.scene.dt
    return dataclasses.replace(state, obstacle_velocity=moved[None])


def _steps(trajectory: Trajectory, metadata: Metadata, frame: int, back: int) -> np.ndarray:
    """(2, N, D) the last two steps of `back` frames until a frame, the earlier one NaN where that is not recorded."""
    last, first = displacements(trajectory.position[frame - back : frame + 1], metadata).sum(axis=0), frame - 2 * back
    if first < 0:
        return np.stack([np.full_like(last, np.nan), last])
    return np.stack([displacements(trajectory.position[first : frame - back + 1], metadata).sum(axis=0), last])


def _velocity(
    model: Pretrained, trajectory: Trajectory, metadata: Metadata, steps: np.ndarray, back: int
) -> np.ndarray:
    """(N, D) velocity in length per second, that between the last two frames of the model, of (2, N, D) `_steps`."""
    ratio = model.scene.dt / (back * metadata.dt)
    ratio = 1.0 if math.isclose(ratio, 1.0, rel_tol=1e-3) else ratio
    pull = trajectory_gravity(trajectory.attributes, metadata, "the trajectory") or (0.0,) * metadata.dim
    before, last = map(torch.from_numpy, steps)
    gravity = last.new_tensor(pull).view(1, -1) * (back * metadata.dt) ** 2
    return model_velocity(last, last - before, gravity, ratio).numpy() / (ratio * back * metadata.dt)


def _metadata(model: Pretrained, trajectory: Trajectory) -> Metadata:
    """The trajectory's; without, all particles are the model's only material."""
    if trajectory.metadata is not None:
        return trajectory.metadata
    scene, kinds = model.scene, np.unique(trajectory.particle_type)
    if len(scene.materials) > 1 or len(kinds) > 1:
        raise DataError(
            f"The trajectory does not say what its particle types {kinds.tolist()} are. Take it from"
            " nmpm.load_trajectories, which knows their names."
        )
    return Metadata(
        bounds=scene.bounds,
        dt=scene.dt,
        dim=trajectory.position.shape[2],
        sequence_length=1,
        particle_types={int(kinds[0]): scene.materials[0]},
        boundary=scene.boundary,
    )


def _materials(model: Pretrained, metadata: Metadata, types: np.ndarray, renamed: Mapping[str, str]) -> list[str]:
    """Names of the particles' materials, of the model's."""
    ids = np.unique(types).tolist()
    names = {i: renamed.get(metadata.particle_types[i], metadata.particle_types[i]) for i in ids}
    theirs = model.scene.materials
    unknown = sorted({name for name in names.values() if name not in theirs})
    if unknown:
        raise DataError(
            f"The trajectory has {', '.join(unknown)}, the model {', '.join(theirs)}.{suggestion(unknown[0], theirs)}"
            f" State which is which: start(…, materials={{{unknown[0]!r}: {theirs[0]!r}}})."
        )
    return [names[i] for i in types.tolist()]


def _gravity(model: Pretrained, trajectory: Trajectory, metadata: Metadata) -> Any:
    """The trajectory's gravity where the model needs one, or knows another than this."""
    scene, gravity = model.scene, trajectory_gravity(trajectory.attributes, metadata, "the trajectory")
    if scene.gravity_varies or gravity is None or scene.gravity is None:
        return gravity if scene.gravity_varies else None
    return None if is_gravity_of(scene, gravity) else gravity


def is_gravity_of(scene: Scene, gravity: Sequence[float]) -> bool:
    """Whether a trajectory's gravity, which may be measured, is that of a model's scene."""
    stated = np.array(scene.gravity)
    return np.allclose(gravity, stated, rtol=0, atol=_SAME_GRAVITY * float(np.abs(stated).max()))


def _fields(model: Pretrained, trajectory: Trajectory, frame: int, moving: np.ndarray) -> dict[str, Any]:
    """Fields of the model's scene that the trajectory has, at a frame."""
    frames, particles = trajectory.position.shape[:2]
    fields: dict[str, Any] = {}
    for name in model.scene.fields:
        values = trajectory.fields.get(name, trajectory.attributes.get(name))
        if values is None:
            continue
        values = np.asarray(values)
        values = values[frame] if values.shape == (frames, particles) else values
        fields[name] = values[moving] if values.shape == (particles,) else values.reshape(())
    return fields
