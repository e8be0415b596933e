"""Kernels that follow gradients back: from the path of a bundle to where it started and what the network predicted, and
from a grid state to the particles that it was made of.

Arrays are those of one scene, as in `flight` and `rasterise`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm.transfer.fused.gather import gather_adjoint
from nmpm.transfer.fused.scatter import scatter_adjoint

ZERO, ONE = np.float32(0), np.float32(1)


@jit
def fly_back(
    cells: Any, material: Any, mask: Any, grid: Any, state: Any, fields: Any, decoder: Any, bounds: Any, path: Any,
    slopes: Any, place: Any, speed: Any, of_state: Any, of_fields: Any,
) -> Any:  # fmt: skip
    """Add to the gradients of what `flight.fly` started from, those of its path given.

    A position that was stopped at a bound passes no gradient on. Padding gets none.

    Args:
        cells: (N, D) positions at the bundle's start.
        material: (N,) int64; empty where there is only one.
        mask: (N,) bool, False for padding.
        grid: The tuple (shape, wraps, steps) of `nmpm.transfer.fused.gather`.
        state: (size, C_in), the grid state.
        fields: (m, size, C), what the network predicts.
        decoder: As for `flight.fly`.
        bounds: As for `flight.fly`; nothing is reflected there.
        path: (m, N, D), as `flight.fly` gives it.
        slopes: (m, N, D), gradient with respect to the path; is overwritten.
        place: (N, D), gradient with respect to the positions at the start.
        speed: (N, D), gradient with respect to the velocities there; holds zeros.
        of_state: (size, C), gradient with respect to the grid state.
        of_fields: (m, size, C), gradient with respect to the fields.
    """
    carries = decoder[3] > ZERO
    for frame in range(len(path) - 1, -1, -1):
        slope = slopes[frame]
        here, target = (path[frame - 1], slopes[frame - 1]) if frame > 0 else (cells, place)
        if carries and frame > 0:  # the velocity of the frame before is a difference of positions
            pass_on(path[frame], mask, bounds, slope, target, target)
            subtract_from(slopes[frame - 2] if frame > 1 else place, slope)
        else:
            pass_on(path[frame], mask, bounds, slope, target, speed)
        gather_adjoint(fields[frame], material, mask, here, grid[0], grid[1], slope, target, of_fields[frame])
    if decoder[1] != ZERO:
        smoothed = decoder[1] * speed
        gather_adjoint(state, material, mask, cells, grid[0], grid[1], smoothed, place, of_state)
    speed *= decoder[0]


@jit
def pass_on(cells: Any, mask: Any, bounds: Any, slope: Any, place: Any, base: Any) -> Any:
    """Add the gradient of positions x + v, (N, D), to those of x and of v.

    Args:
        cells: (N, D), the positions.
        mask: (N,) bool.
        bounds: As for `flight.fly`.
        slope: (N, D) gradient; is set to 0 for padding and where a bound stopped the position.
        place: (N, D) gradient with respect to x.
        base: (N, D) gradient with respect to v.
    """
    for d in range(cells.shape[1]):
        lowest, highest = bounds[0, d], bounds[1, d]
        for p in range(len(cells)):
            x = cells[p, d]
            pull = slope[p, d] if mask[p] and x > lowest and x < highest else ZERO
            slope[p, d] = pull
            place[p, d] += pull
            base[p, d] += pull


@jit
def subtract_from(total: Any, values: Any) -> Any:
    """Subtract (N, D) values."""
    for p in range(len(values)):
        for d in range(values.shape[1]):
            total[p, d] -= values[p, d]


@jit
def rasterise_back(
    moved: Any, material: Any, mask: Any, cells: Any, grid: Any, state: Any, particle_volume: Any, box: Any, slope: Any,
    place: Any, speed: Any,
) -> Any:  # fmt: skip
    """Turn gradients in cells into those in domain length, that of the grid state added.

    Args:
        moved: (N, D) velocities in cells.
        material: (N,) int64; empty where there is only one.
        mask: (N,) bool.
        cells: (N, D) positions in cells.
        grid: The tuple (shape, wraps, steps) of p2g.
        state: (size, C_in), as `fill_state` gives it.
        particle_volume: In cells.
        box: (2, D) the grid's lower corner and the cells' widths, in domain length.
        slope: (size, M D + M), gradient with respect to the first channels of the state; is overwritten.
        place: (N, D), gradient with respect to `cells`, then with respect to positions in domain length.
        speed: (N, D), the same of velocities.
    """
    width = moved.shape[1]
    materials = slope.shape[1] // (width + 1)
    for node in range(len(slope)):
        for own in range(materials):
            volume = materials * width + own
            count = state[node, volume] / particle_volume
            for k in range(own * width, (own + 1) * width):
                slope[node, k] /= count if count > ZERO else ONE
            slope[node, volume] *= particle_volume
    scatter_adjoint(moved, material, mask, cells, grid[0], grid[1], state, slope, place, speed)
    for p in range(len(place)):
        for d in range(width):
            place[p, d] /= box[1, d]
            speed[p, d] /= box[1, d]
