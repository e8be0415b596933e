"""Trajectories by the material point method: from a preset and a seed, or from a given state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import ConfigError, DataError
from nmpm.sim.blocks import draw_start
from nmpm.sim.mls_mpm import Grid, State, Stepper, Walls
from nmpm.sim.mpm_preset import MpmPreset
from nmpm.sim.trajectory import Progress, SimulatedTrajectory


def simulate(preset: MpmPreset, seed: int, progress: Progress | None = None) -> SimulatedTrajectory:
    """A trajectory of `preset.frames` + 1 frames, the same to the bit for the same preset and seed.

    Raises:
        ConfigError: if the preset leaves no room for its blocks, or the state is no longer finite.
    """
    start = draw_start(preset, np.random.default_rng(seed))
    try:
        made = simulate_from(preset, start.position, start.velocity, preset.frames, start.counts, progress)
    except ConfigError as error:
        raise ConfigError(f"Preset {preset.name}, seed {seed}: {error}") from error
    made.attributes["seed"] = seed
    return made


def simulate_from(
    preset: MpmPreset,
    position: NDArray[Any],
    velocity: NDArray[Any],
    frames: int,
    counts: tuple[int, ...] | None = None,
    progress: Progress | None = None,
) -> SimulatedTrajectory:
    """A trajectory from a given state, free of stress, under the preset's physics and grid.

    Args:
        preset: Its blocks and number of frames are not used.
        position: (N, 2) within the box, in length.
        velocity: (N, 2) in length per second.
        frames: Frames to simulate after the given one; frames + 1 are returned.
        counts: Particles of each of the preset's materials, in order; all are of the first when left out.
        progress: Told how many frames are done, after each.

    Raises:
        DataError: if the arrays do not fit together, or a particle is outside of the box.
        ConfigError: if the state is no longer finite; the message names the substep.
    """
    counts = counts or (len(position),) + (0,) * (len(preset.materials) - 1)
    _check_state(preset, position, velocity, counts)
    groups = tuple(zip(preset.materials, counts, strict=True))
    state = State(position, velocity, groups, preset.particle_volume)
    stepper = Stepper(_grid(preset), preset.frame_dt / preset.substeps)
    stepper.enclose(state)
    stored = np.empty((frames + 1, *state.position.shape), np.float32)
    stored[0] = state.position
    for frame in range(1, frames + 1):
        _advance(stepper, state, preset.substeps, frame)
        stored[frame] = state.position
        if progress is not None:
            progress(frame)
    kinds = np.repeat([m.particle_type for m in preset.materials], counts).astype(np.int64)
    return SimulatedTrajectory(stored, kinds, {"held_back": stepper.held_back})


def _advance(stepper: Stepper, state: State, substeps: int, frame: int) -> None:
    for substep in range(substeps):
        try:
            stepper.step(state)
        except FloatingPointError as error:
            raise ConfigError(
                f"{error} after substep {substep + 1} of {substeps} of frame {frame}; take more substeps, slower "
                "particles or a softer material."
            ) from error


def _grid(preset: MpmPreset) -> Grid:
    low, high = np.array(preset.reach).T
    columns, rows = (round(cells) for cells in (high - low) / preset.cell_size)
    gravity = np.array(preset.gravity, dtype=np.float64)
    return Grid(low, preset.cell_size, (columns, rows), preset.wall_friction, gravity, Walls(preset.walls))


def _check_state(
    preset: MpmPreset,
    position: NDArray[Any],
    velocity: NDArray[Any],
    counts: tuple[int, ...],
) -> None:
    if position.ndim != 2 or position.shape[1] != 2 or velocity.shape != position.shape:
        raise DataError(f"Positions {position.shape} and velocities {velocity.shape} must both have shape (N, 2).")
    if len(counts) != len(preset.materials) or sum(counts) != len(position):
        raise DataError(
            f"Counts {counts} do not divide {len(position)} particles among {len(preset.materials)} materials."
        )
    low, high = np.array(preset.reach).T
    inside = np.all((low <= position) & (position <= high) & np.isfinite(velocity), axis=1)
    if not inside.all():
        worst = int(np.argmin(inside))
        raise DataError(
            f"Particle {worst} at {position[worst].tolist()} with velocity {velocity[worst].tolist()} is not finite or "
            f"not within {preset.reach}."
        )
