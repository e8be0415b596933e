"""Trajectories of weakly compressible water: from a preset and a seed, or from a given state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import ConfigError, DataError
from nmpm.sim.gravity import turned
from nmpm.sim.preset import BOUNDARY
from nmpm.sim.sph.preset import WATER, SphPreset
from nmpm.sim.sph.walls import Obstacle, Solids
from nmpm.sim.sph.wcsph import State, Stepper
from nmpm.sim.trajectory import Progress, SimulatedTrajectory

DENSITY_LIMIT = 0.5
"""Largest deviation of a particle's density from that at rest, as a part of it; beyond, the run has blown up."""


def simulate(preset: SphPreset, seed: int, progress: Progress | None = None) -> SimulatedTrajectory:
    """A trajectory of `preset.frames` + 1 frames, the same to the bit for the same preset and seed.

    Raises:
        ConfigError: if the preset leaves no room for blocks or obstacles, or the simulation blows up.
    """
    rng = np.random.default_rng(seed)
    try:
        gravity = turned(preset.gravity, preset.gravity_turn, rng)
        obstacles = preset.obstacles.draw(preset.box, rng) if preset.obstacles is not None else ()
        position, velocity = preset.start.draw(preset.box, preset.spacing, obstacles, rng)
        made = simulate_from(preset, position, velocity, preset.frames, gravity, obstacles, progress)
    except ConfigError as error:
        raise ConfigError(f"Preset {preset.name}, seed {seed}: {error}") from error
    made.attributes["seed"] = seed
    return made


def simulate_from(
    preset: SphPreset,
    position: NDArray[Any],
    velocity: NDArray[Any],
    frames: int,
    gravity: tuple[float, ...] | None = None,
    obstacles: tuple[Obstacle, ...] = (),
    progress: Progress | None = None,
) -> SimulatedTrajectory:
    """A trajectory from a given state at rest density, under the preset's physics and resolution.

    Args:
        preset: Its initial state, obstacles and number of frames are not used.
        position: (N, 2) within the box, in length.
        velocity: (N, 2) in length per second.
        frames: Frames to simulate after the given one; frames + 1 are returned.
        gravity: Instead of the preset's, in length per second squared.
        obstacles: What stands in the fluid's way.
        progress: Told how many frames are done, after each.

    Raises:
        DataError: if the arrays do not fit together, or a particle is outside of the box or in an obstacle.
        ConfigError: if the simulation blows up; the message names the frame.
    """
    _check_state(preset, position, velocity, obstacles)
    gravity = preset.gravity if gravity is None else gravity
    solids = Solids(preset.box, obstacles, preset.spacing)
    state = State(position, velocity, preset.fluid.density)
    stepper = Stepper(preset.fluid, solids, preset.spacing, np.array(gravity), preset.frame_dt / preset.substeps)
    stepper.begin(state)
    shown = solids.position[solids.shown]
    stored = np.empty((frames + 1, len(position) + len(shown), 2), np.float32)
    stored[:, len(position) :] = shown
    stored[0, : len(position)] = state.position
    deviation = 0.0
    for frame in range(1, frames + 1):
        deviation = max(deviation, _advance(stepper, state, preset.substeps, frame))
        stored[frame, : len(position)] = state.position
        if progress is not None:
            progress(frame)
    kinds = np.repeat([WATER, BOUNDARY], [len(position), len(shown)]).astype(np.int64)
    attributes = {"gravity": np.array(gravity), "held_back": stepper.held_back, "density_deviation": deviation}
    return SimulatedTrajectory(stored, kinds, attributes)


def _advance(stepper: Stepper, state: State, substeps: int, frame: int) -> float:
    """Simulates one frame and gives the largest deviation of density at its end."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is found below
            for _ in range(substeps):
                stepper.step(state)
    except FloatingPointError as error:
        raise ConfigError(f"{error} in frame {frame}; take more substeps or a higher speed of sound.") from error
    rest, sound = stepper.fluid.density, stepper.fluid.speed_of_sound
    deviation = float(np.abs(state.density / rest - 1).max())
    fastest = float(np.hypot(*state.velocity.T).max())
    if not (deviation <= DENSITY_LIMIT and fastest <= sound):
        raise ConfigError(
            f"The simulation has blown up in frame {frame}: density deviates by {deviation:.0%} (limit "
            f"{DENSITY_LIMIT:.0%}), the fastest particle moves at {fastest:.3g} m/s (sound: {sound:.3g}). Take more "
            "substeps, a higher speed of sound or more viscosity, or leave this seed out."
        )
    inside = stepper.solids.inside(state.position)
    if inside:
        raise ConfigError(f"{inside} particles are outside of the box or in an obstacle in frame {frame}.")
    return deviation


def _check_state(
    preset: SphPreset, position: NDArray[Any], velocity: NDArray[Any], obstacles: tuple[Obstacle, ...]
) -> None:
    if position.ndim != 2 or position.shape[1] != 2 or velocity.shape != position.shape:
        raise DataError(f"Positions {position.shape} and velocities {velocity.shape} must both have shape (N, 2).")
    low, high = np.array(preset.box).T
    good = np.all((low <= position) & (position <= high) & np.isfinite(velocity), axis=1)
    for obstacle in obstacles:
        good[good] &= obstacle.depth(position[good]) <= 0
    if not good.all():
        worst = int(np.argmin(good))
        raise DataError(
            f"Particle {worst} at {position[worst].tolist()} with velocity {velocity[worst].tolist()} is not finite, "
            f"not within the box {preset.box} or in an obstacle."
        )
