"""Rollouts up to the last trusted frame, and from there on by a simulator.

An emulator knows positions and velocities alone. A simulator that goes on from its last trusted frame takes these, and
starts without strain and pressure: deformation gradients are the identity, densities those at rest. What was compressed
or sheared until then has forgotten it, as if it had just been put there.
"""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nmpm.emulator import Emulator, Rollout
from nmpm.emulator.trust import Trust, predict_trusted
from nmpm.errors import ConfigError, UnstableError
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.sim import InitialState, Preset, load_preset
from nmpm.sim.mpm.mixture import MpmMixture
from nmpm.sim.state import Array, Progress
from nmpm.zoo.scenes import SAME, scene_differences

_LONGEST_RATIO = 64
"""Largest denominator of the ratio between the frames of model and preset."""


def predict_and_simulate(
    emulator: Emulator, trust: Trust, state: Particles, frames: int, preset: Preset | str | Path
) -> Rollout:
    """Predict up to each scene's last trusted frame, `trusted` (B,), and simulate the rest by a preset, or its name."""
    preset = preset if isinstance(preset, Preset) else load_preset(preset)
    preset = fitting_preset(emulator.scene, state, preset)
    trusted = predict_trusted(emulator, trust, state, frames)
    return simulate_rest(emulator.scene, state, trusted, preset, frames)


def simulate_rest(
    scene: Scene,
    state: Particles,
    rollout: Rollout,
    preset: Preset,
    frames: int,
    progress: Progress | None = None,
) -> Rollout:
    """All of so many frames, those that are not trusted simulated by a preset.

    Args:
        scene: The model's, which fits the preset.
        state: That the rollout started from.
        rollout: From `predict_trusted`.
        preset: The simulator.
        frames: How many in all.
        progress: Called after each simulated frame.

    Raises:
        UnstableError: if a simulation becomes unstable.
    """
    batch, made, *rest = rollout.position.shape
    position = rollout.position.new_full((batch, frames, *rest), torch.nan)
    position[:, :made] = rollout.position
    for index, last in enumerate([made] * batch if rollout.trusted is None else rollout.trusted.tolist()):
        if last < frames:
            path = torch.cat([state.position[index, None], position[index, :last]])
            velocity = state.velocity[index] if last == 0 else path[-1] - path[-2]
            start = state.scenes([index]).with_motion(path[-1:], velocity[None].to(path))
            position[index, last:] = simulate_on(scene, start, preset, frames - last, progress).to(position)
    return Rollout(position, {}, rollout.trusted)


def fitting_preset(scene: Scene, state: Particles, preset: Preset) -> Preset:
    """The preset with the frames of a model's scene, from whose state it shall go on.

    Raises:
        ConfigError: naming what differs: a material, the bounds, the volume of particles, what the simulator lacks; or
            obstacles that cannot be told from their particles.
    """
    differences = dict.fromkeys(scene_differences(scene, preset), True) | {
        "its particles are all of one size": state.volume is not None and bool((state.volume[state.mask] != 1).any()),
        f"it has no {', '.join(scene.fields)}": bool(scene.fields),
        "its obstacles do not move": scene.moving_obstacles,
        "it simulates only states that it has drawn": isinstance(preset, MpmMixture),
    }
    for difference, differs in differences.items():
        if differs:
            raise ConfigError(f"fallback: the preset {preset.name} is of other scenes than the model's: {difference}.")
    for index in range(len(state.position)):
        preset.obstacles_from(_obstacle(state, index))
    ratio = scene.dt / preset.frame_dt
    if math.isclose(ratio, 1.0, rel_tol=SAME):
        return preset
    return preset.with_stride(Fraction(ratio).limit_denominator(_LONGEST_RATIO))


def _obstacle(state: Particles, index: int) -> Array:
    """(M, D) obstacle particles of a scene of the batch."""
    return state.obstacle[index, state.obstacle_mask[index]].cpu().double().numpy()


def simulate_on(
    scene: Scene, state: Particles, preset: Preset, frames: int, progress: Progress | None = None
) -> Tensor:
    """(frames, N, D) positions that a preset makes of the only scene of a state, whose own frame is not among them.

    Positions and velocities are the state's, strain and pressure start anew. Padding is NaN.

    Raises:
        UnstableError: if the simulation becomes unstable.
    """
    start, order = initial_state(scene, state, preset)
    try:
        made = preset.simulate_from(start, frames, progress).position[1:, : len(order)]
    except UnstableError as error:
        raise UnstableError(f"fallback: {preset.name}, from the last trusted frame on: {error}") from error
    simulated = torch.full((frames, *state.position.shape[1:]), torch.nan)
    simulated[:, state.mask[0].cpu().nonzero()[:, 0][torch.from_numpy(order)]] = torch.from_numpy(made)
    return simulated


def initial_state(scene: Scene, state: Particles, preset: Preset) -> tuple[InitialState, NDArray[np.int64]]:
    """What the simulator starts from, and the state's particles in the simulator's order, by material."""
    real, names = state.mask[0].cpu().numpy(), preset.scene.materials
    kinds = np.array([names.index(name) for name in scene.materials])[state.material[0].cpu().numpy()[real]]
    order = np.argsort(kinds, kind="stable")
    position, velocity = (
        values[0].detach().cpu().double().numpy()[real][order] for values in (state.position, state.velocity)
    )
    low, high = np.array(preset.reach).T
    gravity = tuple((state.gravity[0].double() / scene.dt**2).tolist()) if scene.gravity_known else None
    counts = tuple(np.bincount(kinds, minlength=len(names)).tolist())
    obstacles = preset.obstacles_from(_obstacle(state, 0))
    # (beyond the simulator's walls by rounding alone)
    return InitialState(np.clip(position, low, high), velocity / scene.dt, gravity, counts, obstacles), order
