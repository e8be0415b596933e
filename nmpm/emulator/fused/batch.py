"""The kernels for a batch of scenes as functions of arrays: p2g, the way through a bundle, and what it ends in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from nmpm._support.threads import map_ranges, split
from nmpm.emulator.fused.arrays import check_materials, output_arrays
from nmpm.emulator.fused.crowd import CrowdArrays, spread_scene
from nmpm.emulator.fused.flight import land
from nmpm.emulator.fused.path import SceneArrays, clear_of_obstacles, fly_scene, rest_scene
from nmpm.emulator.fused.plan import Array, Plan
from nmpm.emulator.fused.rasterise import rasterise_scene
from nmpm.emulator.fused.surroundings import Surroundings

_CHUNK = 2**14


@dataclass(frozen=True)
class Batch:
    """The particles of B scenes in grid units, and the grid state.

    Args:
        cells: (B, N, D) positions.
        velocity: (B, N, D).
        gravity: (B, D).
        material: (B, N) int64; (B, 0) where there is only one.
        mask: (B, N) bool.
        state: (B, size, C_in).
    """

    cells: Array
    velocity: Array
    gravity: Array
    material: Array
    mask: Array
    state: Array


def rasterise_batch(
    plan: Plan, position: Array, velocity: Array, gravity: Array, material: Array, mask: Array, solid: Array
) -> Batch:
    """Particles in grid units, and the grid state.

    Args:
        plan: Of the emulator.
        position: (B, N, D) in domain length.
        velocity: (B, N, D) in domain length per frame.
        gravity: (B, D) in domain length per frame squared.
        material: As in `Batch`.
        mask: As in `Batch`.
        solid: (B, C_solid, *S).
    """
    cells, moved = np.empty((2, *position.shape), np.float32)
    pull, solids = gravity / plan.box[1], solid.reshape(*solid.shape[:2], plan.size)
    state = np.empty((len(position), plan.size, plan.channels), np.float32)
    threads = torch.get_num_threads()
    for scene in range(len(position)):
        rasterise_scene(
            plan, position[scene], velocity[scene], pull[scene], material[scene], mask[scene], solids[scene],
            cells[scene], moved[scene], state[scene], threads,
        )  # fmt: skip
    return Batch(cells, moved, pull, material, mask, state)


def fly_batch(
    plan: Plan, start: Batch, output: Tensor, scale: Array, budget: Array | None,
    known: Sequence[Surroundings],
) -> Array:  # fmt: skip
    """(B, m, N, D) positions in cells, as `Advection.constrained_path` gives them.

    Args:
        plan: Of the emulator.
        start: Where the bundle starts.
        output: (B, m, C, *S), what the network predicts.
        scale: (m C,), by which it is multiplied.
        budget: (B,) energy that no frame may exceed; None for no such limit.
        known: Of each scene.

    Raises:
        IndexError: if a particle's material is none of the scene's.
    """
    batch, count, dim = start.cells.shape
    frames, threads = output.shape[1], torch.get_num_threads()
    path = np.empty((batch, frames, count, dim), np.float32)  # asks for huge pages, which a fresh tensor does not
    check_materials(plan, start.material)
    predicted, unpack = output_arrays(output)
    flows = np.empty((frames, plan.size, output.shape[2]), np.float32)
    for scene in range(batch):
        unpack(predicted[scene], scale, flows)
        own = SceneArrays(
            start.cells[scene], start.velocity[scene], start.material[scene], start.mask[scene], start.gravity[scene],
            start.state[scene], flows,
        )  # fmt: skip
        fly_scene(own, plan, None if budget is None else float(budget[scene]), path[scene], threads)
        if plan.obstacles and plan.solids:
            clear_of_obstacles(own, plan, known[scene], path[scene], threads)
        if plan.rest_speed:
            rest_scene(own, plan, known[scene].share, path[scene], threads)
    return path


def spread_batch(plan: Plan, start: Batch, path: Array, budget: Array | None, known: Sequence[Surroundings]) -> Array:
    """(B, m, N, D) positions with overfull cells spread, as `Advection.uncrowded_path` gives them; in fresh memory.

    By a plan with a density cap; arguments as of `fly_batch`.
    """
    spread, threads = np.empty_like(path), torch.get_num_threads()
    for scene, around in enumerate(known):
        own = CrowdArrays(
            start.cells[scene], start.material[scene], start.mask[scene], start.gravity[scene], path[scene]
        )
        spread_scene(own, plan, around, None if budget is None else float(budget[scene]), spread[scene], threads)
    return spread


def to_grid(plan: Plan, rows: Array) -> Tensor:
    """Rows (B, size, C), one per node, as a tensor (B, C, *S) of the same memory."""
    return torch.from_numpy(rows.reshape(len(rows), *plan.shape, rows.shape[2])).movedim(-1, 1)


def land_batch(plan: Plan, path: Array) -> Array:
    """The path (B, m, N, D) in domain length, in its own memory: fresh memory would take longer than the conversion."""
    for frames in path:
        convert = partial(land, frames, plan.box)
        map_ranges(convert, split(frames.shape[1], _CHUNK), torch.get_num_threads())
    return path
