"""Trajectories by the material point method: from a preset and a seed, or from a given state."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import ConfigError, DataError
from nmpm.sim.blocks import Start, draw_start
from nmpm.sim.gravity import turned
from nmpm.sim.mls_mpm import Grid, State, Stepper, Walls
from nmpm.sim.mls_mpm_3d import Stepper3d
from nmpm.sim.mpm_preset import MpmPreset
from nmpm.sim.obstacles import Ramp, distance
from nmpm.sim.preset import BOUNDARY
from nmpm.sim.solid import Solid
from nmpm.sim.trajectory import Progress, SimulatedTrajectory

_ARRANGEMENTS = 20
STEPPERS: dict[int, type[Stepper]] = {2: Stepper, 3: Stepper3d}


def simulate(preset: MpmPreset, seed: int, progress: Progress | None = None) -> SimulatedTrajectory:
    """A trajectory of `preset.frames` + 1 frames, the same to the bit for the same preset and seed.

    Raises:
        ConfigError: if the preset leaves no room for its blocks, or the state is no longer finite.
    """
    rng = np.random.default_rng(seed)
    try:
        gravity = turned(preset.gravity, preset.gravity_turn, rng)
        start, ramps = draw_scene(preset, rng)
        made = simulate_from(
            preset, start.position, start.velocity, preset.frames, start.counts, progress, gravity, ramps
        )
    except ConfigError as error:
        raise ConfigError(f"Preset {preset.name}, seed {seed}: {error}") from error
    made.attributes["seed"] = seed
    if preset.gravity_turn:
        made.attributes["gravity"] = np.array(gravity)
    return made


def draw_scene(preset: MpmPreset, rng: np.random.Generator) -> tuple[Start, tuple[Ramp, ...]]:
    """An initial state, and the ramps beside it.

    Raises:
        ConfigError: if no arrangement is found, so crowded is the box.
    """
    for _ in range(_ARRANGEMENTS):
        start = draw_start(preset, rng)
        if preset.ramps is None:
            return start, ()
        try:
            return start, preset.ramps.draw(preset.box, start.extents, rng)
        except ConfigError as error:  # These blocks leave no room; others may.
            reason = error
    raise reason


def simulate_from(
    preset: MpmPreset,
    position: NDArray[Any],
    velocity: NDArray[Any],
    frames: int,
    counts: tuple[int, ...] | None = None,
    progress: Progress | None = None,
    gravity: tuple[float, ...] | None = None,
    ramps: tuple[Ramp, ...] = (),
) -> SimulatedTrajectory:
    """A trajectory from a given state, free of stress, under the preset's physics and grid.

    Args:
        preset: Its blocks, ramps and number of frames are not used.
        position: (N, D) within the box, in length.
        velocity: (N, D) in length per second.
        frames: Frames to simulate after the given one; frames + 1 are returned.
        counts: Particles of each of the preset's materials, in order; all are of the first when left out.
        progress: Told how many frames are done, after each.
        gravity: Instead of the preset's, in length per second squared.
        ramps: Obstacles; their particles, at rest, follow the others.

    Raises:
        DataError: if the arrays do not fit together, or a particle is outside of the box or inside of a ramp.
        ConfigError: if the state is no longer finite; the message names the substep.
    """
    counts = counts or (len(position),) + (0,) * (len(preset.materials) - 1)
    _check_state(preset, position, velocity, counts)
    groups = tuple(zip(preset.materials, counts, strict=True))
    state = State(position, velocity, groups, preset.particle_volume)
    stepper = STEPPERS[preset.dim](_grid(preset, gravity or preset.gravity, ramps), preset.frame_dt / preset.substeps)
    stepper.enclose(state)
    solid = np.concatenate([np.empty((0, preset.dim)), *(ramp.particles(preset.spacing) for ramp in ramps)])
    moving = len(position)
    stored = np.empty((frames + 1, moving + len(solid), preset.dim), np.float32)
    stored[0, :moving], stored[:, moving:] = state.position, solid
    for frame in range(1, frames + 1):
        _advance(stepper, state, preset.substeps, frame)
        stored[frame, :moving] = state.position
        if progress is not None:
            progress(frame)
    types = [*(material.particle_type for material in preset.materials), BOUNDARY]
    kinds = np.repeat(types, [*counts, len(solid)]).astype(np.int64)
    counters = {"held_back": stepper.held_back} | ({"pushed_out": stepper.pushed_out} if ramps else {})
    return SimulatedTrajectory(stored, kinds, counters)


def _advance(stepper: Stepper, state: State, substeps: int, frame: int) -> None:
    for substep in range(substeps):
        try:
            stepper.step(state)
        except FloatingPointError as error:
            raise ConfigError(
                f"{error} after substep {substep + 1} of {substeps} of frame {frame}; take more substeps, slower "
                "particles or a softer material."
            ) from error


def _grid(preset: MpmPreset, gravity: tuple[float, ...], ramps: tuple[Ramp, ...]) -> Grid:
    low, high = np.array(preset.reach).T
    shape = tuple(round(cells) for cells in (high - low) / preset.cell_size)
    fall = np.array(gravity, dtype=np.float64)
    grid = Grid(low, preset.cell_size, shape, preset.wall_friction, fall, Walls(preset.walls))
    if not ramps:
        return grid
    return replace(grid, solid=Solid.sample(grid, partial(distance, ramps), preset.wall_friction))


def _check_state(
    preset: MpmPreset,
    position: NDArray[Any],
    velocity: NDArray[Any],
    counts: tuple[int, ...],
) -> None:
    if position.ndim != 2 or position.shape[1] != preset.dim or velocity.shape != position.shape:
        raise DataError(
            f"Positions {position.shape} and velocities {velocity.shape} must both have shape (N, {preset.dim})."
        )
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
