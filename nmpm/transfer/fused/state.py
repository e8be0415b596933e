"""The grid state that a network sees, from particles in domain length."""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit

ZERO, ONE = np.float32(0), np.float32(1)


@jit
def to_cells(position: Any, velocity: Any, box: Any, cells: Any, moved: Any) -> Any:
    """Fill in positions and velocities (N, D) in cells, from those in domain length and the (2, D) `box`."""
    for p in range(len(position)):
        for d in range(position.shape[1]):
            cells[p, d] = (position[p, d] - box[0, d]) / box[1, d]
            moved[p, d] = velocity[p, d] / box[1, d]


@jit
def fill_state(sums: Any, width: Any, particle_volume: Any, solid: Any, constants: Any, state: Any) -> Any:
    """Fill in the channels of a grid state.

    Args:
        sums: (size, M V + M): sums of V values of each material, then numbers of particles.
        width: V.
        particle_volume: In cells.
        solid: (size,) share of each cell that is solid; empty where there is no such channel.
        constants: (K,) values that are the same everywhere.
        state: (size, M V + M + ...): mean values, shares of volume, the solid, the constants.
    """
    materials = sums.shape[1] // (width + 1)
    for node in range(len(sums)):
        for own in range(materials):
            count = sums[node, materials * width + own]
            total = count if count > ZERO else ONE
            for k in range(own * width, (own + 1) * width):
                state[node, k] = sums[node, k] / total
            state[node, materials * width + own] = count * particle_volume
        channel = sums.shape[1]
        if len(solid):
            state[node, channel] = solid[node]
            channel += 1
        for k in range(len(constants)):
            state[node, channel + k] = constants[k]
