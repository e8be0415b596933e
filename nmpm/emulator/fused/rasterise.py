"""p2g of a batch: what `nmpm.emulator.rasterise.grid_state` gives, and the particles in grid units."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from nmpm._support.threads import map_ranges, split
from nmpm.emulator.fused.plan import Array, Plan
from nmpm.transfer.fused.scatter import scatter
from nmpm.transfer.fused.state import fill_state, to_cells

_CHUNK = 2**16  # particles; each chunk has a grid of its own, so that sums do not depend on the number of threads
_NONE = np.empty(0, np.float32)


def rasterise_scene(
    plan: Plan, position: Array, velocity: Array, gravity: Array, material: Array, mask: Array, solid: Array,
    cells: Array, moved: Array, state: Array, threads: int,
) -> None:  # fmt: skip
    """Fill in positions and velocities in cells, and the grid state of a scene.

    Args:
        plan: Of the emulator.
        position: (N, D) in domain length.
        velocity: (N, D) in domain length per frame.
        gravity: (D,) in cells.
        material: (N,) int64; empty where there is only one.
        mask: (N,) bool.
        solid: (C_solid, size).
        cells: (N, D) positions, is filled.
        moved: (N, D) velocities, is filled.
        state: (size, C_in), is filled.
        threads: How many work.
    """
    ranges = split(len(cells), max(_CHUNK, 4 * len(state)))
    convert = partial(_add_range, plan, position, velocity, material, mask, cells, moved, len(state))
    parts = map_ranges(convert, ranges, threads)
    sums = parts[0] if parts else np.zeros((len(state), len(plan.mass) * (plan.dim + 1)), np.float32)
    for part in parts[1:]:
        sums += part
    own = solid[0] if plan.solid else _NONE
    constants = gravity if plan.constants else _NONE
    fill_state(sums, plan.dim, np.float32(plan.particle_volume), own, constants, state)


def _add_range(
    plan: Plan, position: Array, velocity: Array, material: Array, mask: Array, cells: Array, moved: Array, size: int,
    low: int, high: int,
) -> Any:  # fmt: skip
    sums = np.zeros((size, len(plan.mass) * (plan.dim + 1)), np.float32)
    here, own = cells[low:high], moved[low:high]
    to_cells(position[low:high], velocity[low:high], plan.box, here, own)
    shape, wraps, steps = plan.scatter_grid
    scatter(own, material[low:high], mask[low:high], here, shape, wraps, steps, sums)
    return sums
