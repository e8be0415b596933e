"""The grid state that a network sees, from particles in domain length."""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit

ZERO, ONE = np.float32(0), np.float32(1)


@jit
def to_cells(position: Any, velocity: Any, box: Any, cells: Any, moved: Any) -> Any:
    """Fill in positions and velocities (N, D) in cells, from those in domain length and the (2, D) `box`."""
    for d in range(position.shape[1]):
        lowest, width = box[0, d], box[1, d]
        for p in range(len(position)):
            cells[p, d] = (position[p, d] - lowest) / width
            moved[p, d] = velocity[p, d] / width


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


@jit
def normalise(state: Any, low: Any, high: Any, mean: Any, deviation: Any, out: Any) -> Any:
    """Fill in what the network sees (size, C) of a grid state (size, C), as `Emulator.normalise`; NaN stays.

    Args:
        state: In grid units.
        low: (C,), as are all statistics.
        high: The range that values are clipped to.
        mean: Is subtracted.
        deviation: Is divided by.
        out: Is filled.
    """
    for c in range(state.shape[1]):
        least, most, middle, width = low[c], high[c], mean[c], deviation[c]
        for node in range(len(state)):
            value = state[node, c]
            value = most if value > most else value
            value = least if value < least else value
            out[node, c] = (value - middle) / width
