"""Kernels that move particles: frame by frame through a bundle, as `nmpm.emulator.advection` does.

Arrays are those of one scene: positions and velocities (N, D), paths (m, N, D), all in cells. Each kernel treats the
particles from `low` to `high`, so that threads share a scene.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit, jit_sum
from nmpm.transfer.fused.gather import gather

_BLOCK = 512  # particles: their places and velocities stay in the fastest cache
ZERO, HALF = np.float32(0), np.float32(0.5)


@jit
def fly(
    cells: Any,
    velocity: Any,
    material: Any,
    gravity: Any,
    share: Any,
    grid: Any,
    state: Any,
    fields: Any,
    decoder: Any,
    bounds: Any,
    ratio: Any,
    carried: Any,
    path: Any,
    low: Any,
    high: Any,
) -> Any:
    """Fill in `carried` and `path` without constraints but the bounds, and return the energies (m,) of the frames.

    Args:
        cells: (N, D) positions at the bundle's start.
        velocity: (N, D) there.
        material: (N,) int64; empty where there is only one.
        gravity: (D,), what a frame adds to a velocity.
        share: (N,) of the scene's mass; empty where energies are not needed.
        grid: The tuple (shape, wraps, steps) of `nmpm.transfer.fused.gather`.
        state: (size, C), the grid state, whose first channels are velocities.
        fields: (m, size, C), what the network predicts.
        decoder: A tuple of shares: of the particle's own velocity and of the grid's in the carried one, of gravity,
            and 1 if each frame's velocity is carried to the next.
        bounds: (3, D): lowest and highest positions, infinite on periodic axes; and 1 in the last row to reflect.
        ratio: (D,) widths of the cells over that of the first axis.
        carried: (N, D), is filled.
        path: (m, N, D), is filled.
        low: The first particle.
        high: The one after the last.
    """
    frames, dim = len(fields), cells.shape[1]
    energies = np.zeros(frames)
    scratch, kept = np.empty((_BLOCK, dim), np.float32), np.empty((_BLOCK, dim), np.float32)
    for begin in range(low, high, _BLOCK):
        end = min(begin + _BLOCK, high)
        start, own = cells[begin:end], material[begin:end]
        carry(start, velocity[begin:end], own, grid, state, decoder, scratch, carried[begin:end])
        before, base, falls = start, carried[begin:end], np.float32(1)
        for frame in range(frames):
            here = path[frame - 1, begin:end] if frame > 0 else start
            if frame > 0 and decoder[3] > ZERO:
                subtract(here, before, kept)
                base = kept[: end - begin]
            falls = np.float32(1) if decoder[3] > ZERO else np.float32(frame + 1)
            gather(fields[frame], own, here, grid[0], grid[1], grid[2], scratch)
            move(here, base, scratch, gravity, decoder[2] * falls, bounds, path[frame, begin:end])
            if len(share):
                energies[frame] += energy(path[frame, begin:end], here, gravity, share[begin:end], ratio)
            before = here
    return energies


@jit
def carry(
    cells: Any, velocity: Any, material: Any, grid: Any, state: Any, decoder: Any, scratch: Any, carried: Any
) -> Any:
    """Fill in the velocities that the decoder lets particles keep."""
    if decoder[1] != ZERO:
        gather(state, material, cells, grid[0], grid[1], grid[2], scratch)
    for p in range(len(cells)):
        for d in range(cells.shape[1]):
            kept = ZERO  # not a sum over zero shares, which would make NaN of infinite velocities
            if decoder[0] != ZERO:
                kept += decoder[0] * velocity[p, d]
            if decoder[1] != ZERO:
                kept += decoder[1] * scratch[p, d]
            carried[p, d] = kept


@jit
def subtract(these: Any, those: Any, out: Any) -> Any:
    """Fill in differences."""
    for p in range(len(these)):
        for d in range(these.shape[1]):
            out[p, d] = these[p, d] - those[p, d]


@jit
def move(cells: Any, base: Any, gathered: Any, gravity: Any, falls: Any, bounds: Any, out: Any) -> Any:
    """Fill in positions after a frame with the velocities base + falls · gravity + gathered, within the bounds."""
    for d in range(cells.shape[1]):
        fall = gravity[d] * falls if falls > ZERO else ZERO
        lowest, highest, reflects = bounds[0, d], bounds[1, d], bounds[2, d] > ZERO
        for p in range(len(cells)):
            out[p, d] = confine(cells[p, d] + (base[p, d] + fall + gathered[p, d]), lowest, highest, reflects)


@jit
def confine(x: Any, lowest: Any, highest: Any, reflects: Any) -> Any:
    """A coordinate within the bounds; NaN stays."""
    if reflects:
        x = lowest + (lowest - x) if x < lowest else (highest + (highest - x) if x > highest else x)
    x = highest if x > highest else x
    return lowest if x < lowest else x


@jit_sum
def energy(cells: Any, before: Any, gravity: Any, share: Any, ratio: Any) -> Any:
    """Energy of particles, weighted by their shares, from their positions after and before a frame."""
    total = ZERO
    for d in range(cells.shape[1]):
        fall, wide = gravity[d] * ratio[d] * ratio[d], HALF * ratio[d] * ratio[d]
        for p in range(len(cells)):
            step = cells[p, d] - before[p, d]
            total += share[p] * (wide * step * step - cells[p, d] * fall)
    return np.float64(total)


@jit
def weigh(material: Any, mask: Any, mass: Any, share: Any) -> Any:
    """Fill in (N,) shares of the scene's mass, 0 for padding, from the mass (M,) of a particle of each material."""
    total = 0.0
    for p in range(len(mask)):
        own = mass[material[p]] if len(mass) > 1 else np.float32(1)
        share[p] = own if mask[p] else ZERO
        total += share[p]
    scale = np.float32(1 / total) if total > 0 else ZERO
    for p in range(len(mask)):
        share[p] *= scale


@jit
def last_velocity(cells: Any, path: Any, box: Any, velocity: Any) -> Any:
    """Fill in velocities (N, D) in domain length per frame from the last step of a path (m, N, D) from `cells`."""
    frames = len(path)
    last = path[frames - 1]
    before = path[frames - 2] if frames > 1 else cells
    for d in range(cells.shape[1]):
        width = box[1, d]
        for p in range(len(cells)):
            velocity[p, d] = (last[p, d] - before[p, d]) * width


@jit
def first_excess(energies: Any, limit: Any) -> Any:
    """Index of the first energy above the limit; their number where there is none."""
    for frame in range(len(energies)):
        if energies[frame] > limit:
            return frame
    return len(energies)


@jit
def land(path: Any, box: Any, low: Any, high: Any) -> Any:
    """Convert a path (m, N, D) to domain length in place.

    Args:
        path: In cells.
        box: (2, D) the grid's lower corner and the cells' widths, in domain length.
        low: The first particle.
        high: The one after the last.
    """
    for frame in range(len(path)):
        own = path[frame, low:high]  # a slice, as Numba's check for negative indices is slow
        for d in range(own.shape[1]):
            lowest, width = box[0, d], box[1, d]
            for p in range(len(own)):
                own[p, d] = own[p, d] * width + lowest
