"""The kernels for a batch of scenes as functions of tensors: p2g, the way through a bundle, and back to domain length.

Shapes as in `nmpm.particles`; tensors are float32 on the CPU and carry no gradients.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.parallel import map_ranges, split
from nmpm.emulator.fused.arrays import as_array, check_materials, material_rows, output_rows
from nmpm.emulator.fused.crowd import CrowdArrays, spread_scene
from nmpm.emulator.fused.flight import land
from nmpm.emulator.fused.path import SceneArrays, check_scene_reads, clear_of_obstacles, fly_scene, rest_scene
from nmpm.emulator.fused.plan import Plan
from nmpm.emulator.fused.rasterise import rasterise_scene
from nmpm.emulator.fused.surroundings import Surroundings, survey, survey_rollout

__all__ = ["predict_path", "rasterise", "survey", "survey_rollout", "to_length", "uncrowd"]

_CHUNK = 2**14


def rasterise(
    plan: Plan, position: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor, mask: Tensor, solid: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Particles in grid units, and the grid state.

    Returns:
        (B, N, D) positions, (B, N, D) velocities and (B, 1, D) gravity in cells; (B, C_in, *S) grid state, whose
        channels lie next to each other in memory.
    """
    batch, count, dim = position.shape
    cells, moved = np.empty((2, batch, count, dim), np.float32)
    pull = as_array(gravity) / plan.box[1]
    channels = len(plan.mass) * (dim + 1) + plan.solid + dim * plan.constants
    state = np.empty((batch, *plan.shape, channels), np.float32)
    kinds, threads = material_rows(material, len(plan.mass)), torch.get_num_threads()
    solids = as_array(solid).reshape(batch, solid.shape[1], state[0].size // channels)
    inputs: tuple[Any, ...] = (
        as_array(position),
        as_array(velocity),
        pull,
        kinds,
        as_array(mask),
        solids,
        cells,
        moved,
    )
    rows = state.reshape(batch, solids.shape[2], channels)
    for scene in range(batch):
        first, speed, fall, kind, real, wall, here, own = (values[scene] for values in inputs)
        rasterise_scene(plan, first, speed, fall, kind, real, wall, here, own, rows[scene], threads)
    tensors = map(torch.from_numpy, (cells, moved, pull.reshape(batch, 1, dim), state))
    positions, velocities, falls, grid = tensors
    return positions, velocities, falls, grid.movedim(-1, 1)


def predict_path(
    plan: Plan, cells: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor, mask: Tensor, state: Tensor,
    output: Tensor, scale: Tensor, solid: Tensor, walls: Tensor, budget: Tensor | None, readable: Tensor | None = None,
    surroundings: Sequence[Surroundings] | None = None,
) -> Tensor:  # fmt: skip
    """(B, m, N, D) positions in cells, as `Advection.constrained_path` gives them.

    The surroundings of each scene, from `survey` or `survey_rollout`, are found where they are left out.

    Raises:
        UncoveredReadError: if a particle reads the output where it must not, see `Departure`.
        IndexError: if a particle's material is none of the scene's.
    """
    batch, count, dim = cells.shape
    frames, size = output.shape[1], math.prod(plan.shape)
    path = np.empty((batch, frames, count, dim), np.float32)  # asks for huge pages, which a fresh tensor does not
    own, threads = material_rows(material, len(plan.mass)), torch.get_num_threads()
    check_materials(plan, own)
    rows = as_array(state.movedim(1, -1)).reshape(batch, size, state.shape[1])
    factors, flows = as_array(scale).reshape(-1), np.empty((frames, size, output.shape[2]), np.float32)
    predicted, unpack = output_rows(output)
    known = survey(plan, solid, walls) if surroundings is None else surroundings
    inputs: tuple[Any, ...] = (as_array(cells), as_array(velocity), own, as_array(mask), as_array(gravity)[:, 0], rows)
    for scene in range(batch):
        unpack(predicted[scene], factors, flows)
        here, speed, kind, real, fall, grid = (values[scene] for values in inputs)
        start = SceneArrays(here, speed, kind, real, fall, grid, flows)
        fly_scene(start, plan, None if budget is None else float(budget[scene]), path[scene], threads)
        if readable is not None:
            check_scene_reads(start, plan, as_array(readable[scene]).reshape(-1), path[scene], threads)
        if plan.obstacles and plan.solids:
            clear_of_obstacles(start, plan, known[scene], path[scene], threads)
        if plan.rest_speed:
            rest_scene(start, plan, known[scene].share, path[scene], threads)
    return torch.from_numpy(path)


def uncrowd(
    plan: Plan, cells: Tensor, gravity: Tensor, material: Tensor, mask: Tensor, path: Tensor, solid: Tensor,
    walls: Tensor, budget: Tensor | None, surroundings: Sequence[Surroundings] | None = None,
) -> Tensor:  # fmt: skip
    """(B, m, N, D) positions with overfull cells spread, as `Advection.uncrowded_path` gives them; in fresh memory.

    From a path (B, m, N, D) of `predict_path`, and by a plan with a density cap.
    """
    known = survey(plan, solid, walls) if surroundings is None else surroundings
    own, threads = material_rows(material, len(plan.mass)), torch.get_num_threads()
    spread = np.empty(path.shape, np.float32)
    inputs: tuple[Any, ...] = (as_array(cells), own, as_array(mask), as_array(gravity)[:, 0], as_array(path))
    for scene, around in enumerate(known):
        arrays = CrowdArrays(*(values[scene] for values in inputs))
        spread_scene(arrays, plan, around, None if budget is None else float(budget[scene]), spread[scene], threads)
    return torch.from_numpy(spread)


def to_length(plan: Plan, path: Tensor) -> Tensor:
    """The path (B, m, N, D) in domain length, in its own memory: fresh memory would take longer than the conversion."""
    for frames in path.numpy():
        convert = partial(land, frames, plan.box)
        map_ranges(convert, split(frames.shape[1], _CHUNK), torch.get_num_threads())
    return path
