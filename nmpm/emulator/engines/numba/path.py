"""Paths through a bundle, frame by frame, free or within an energy: as the torch engine's `advection` computes.

The free path is tried first, and kept up to the first frame that exceeds the energy, if any does.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from nmpm._support.jit import jit, jit_sum
from nmpm._support.threads import map_ranges, split
from nmpm.emulator.engines.numba.gather import gather
from nmpm.emulator.engines.numba.parameters import Array, KernelParameters
from nmpm.emulator.engines.numba.state import StartArrays

CHUNK = 2**14
"""Particles that a thread treats at once; sums do not depend on the number of threads."""

ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Share of an energy by which sums of float32 may exceed it."""

BLOCK = 512
"""Particles whose positions and velocities stay in the fastest cache."""

_TINY = float(np.finfo(np.float32).tiny)
_ROUNDING = np.float32(ROUNDING)
ZERO, HALF = np.float32(0), np.float32(0.5)


def find_path(
    start: StartArrays, fields: Array, parameters: KernelParameters, budget: float | None, threads: int
) -> None:
    """Fill in the path of a scene within the bounds, and within the energy `budget` if there is one."""
    path, (grid, bounds, ratio) = start.path, (parameters.g2p_grid, parameters.bounds, parameters.ratio)
    ranges, decoder = split(len(start.mask), CHUNK), parameters.decoder
    mass = np.empty(0 if budget is None else len(start.mask), np.float32)
    if budget is not None:
        fill_mass(start.material, start.mask, start.volume, parameters.mass, mass)
    carried = np.empty_like(start.velocity)
    move = partial(
        free_path, path, start.velocity, start.material, start.gravity, mass, grid, start.state, fields, decoder,
        bounds, ratio, carried,
    )  # fmt: skip
    energies = map_ranges(move, ranges, threads)
    if budget is None or not energies:
        return
    limit = budget + ROUNDING * abs(budget)
    exceeds = (frame for frame, energy in enumerate(sum(energies[1:], energies[0]).tolist()) if energy > limit)
    for frame in range(next(exceeds, len(fields)), len(fields)):
        propose = partial(
            propose_frame, path, start.velocity, start.material, start.gravity, mass, grid, fields, decoder, bounds,
            ratio, carried, frame,
        )  # fmt: skip
        factor, only_gainers = _affordable(sum(map_ranges(propose, ranges, threads)).tolist(), budget)
        if factor < 1:
            shorten = partial(
                shorten_frame, path, start.velocity, start.gravity, bounds, ratio, frame, np.float32(factor),
                only_gainers,
            )  # fmt: skip
            map_ranges(shorten, ranges, threads)


def _affordable(sums: list[float], budget: float) -> tuple[float, bool]:
    """The factor for steps that keeps the energy, and whether it is for those alone that gain energy.

    As the torch engine's `energy`, from the sums of `propose_frame`.
    """
    height, kinetic_gained, kinetic, fall_gained, fall = sums
    excess = max(height - budget, -1e18)
    if not kinetic + fall + excess > 0:
        return 1.0, False
    factor, exact = _largest_root(kinetic_gained, fall_gained, excess + (kinetic + fall - kinetic_gained - fall_gained))
    if exact and 0 <= factor <= 1:
        return factor, True
    factor, _ = _largest_root(kinetic, fall, excess)
    return min(max(factor, 0.0), 1.0), False


def _largest_root(square: float, slope: float, constant: float) -> tuple[float, bool]:
    """Largest s with square · s² + slope · s + constant = 0, and whether there is one; else where that is lowest."""
    inner = slope * slope - 4 * square * constant
    moves = square > math.sqrt(_TINY)
    return (math.sqrt(max(inner, _TINY)) - slope) / (2 * square if moves else 1.0), moves and inner >= 0


@jit
def fill_mass(material: Any, mask: Any, volume: Any, particle_mass: Any, mass: Any) -> Any:
    """Fill in each particle's share of the scene's mass, from the mass (M,) of a particle of each material."""
    total = 0.0
    for p in range(len(mask)):
        each = particle_mass[material[p]] if len(particle_mass) > 1 else np.float32(1)
        if len(volume):
            each *= volume[p]
        mass[p] = each if mask[p] else ZERO
        total += mass[p]
    scale = np.float32(1 / total) if total > 0 else ZERO
    for p in range(len(mask)):
        mass[p] *= scale


@jit
def free_path(
    path: Any, velocity: Any, material: Any, gravity: Any, mass: Any, grid: Any, state: Any, fields: Any, decoder: Any,
    bounds: Any, ratio: Any, carried: Any, low: Any, high: Any,
) -> Any:  # fmt: skip
    """Fill in the path, and the velocities `carried` (N, D) that the decoder lets particles keep.

    Returns:
        (m,) energies of the frames; zeros where `mass` is empty.
    """
    frames, dim = len(fields), path.shape[2]
    energies = np.zeros(frames)
    scratch, kept = np.empty((BLOCK, dim), np.float32), np.empty((BLOCK, dim), np.float32)
    for begin in range(low, high, BLOCK):
        end = min(begin + BLOCK, high)
        start, kinds = path[0, begin:end], material[begin:end]
        _fill_carried(start, velocity[begin:end], kinds, grid, state, decoder, scratch, carried[begin:end])
        for frame in range(frames):
            _move_block(
                path, material, gravity, grid, fields, decoder, bounds, carried, frame, begin, end, scratch, kept
            )
            if len(mass):
                arrived = path[frame + 1, begin:end]
                energies[frame] += energy(arrived, arrived, path[frame, begin:end], gravity, mass[begin:end], ratio)
    return energies


@jit
def _fill_carried(
    cells: Any, velocity: Any, material: Any, grid: Any, state: Any, decoder: Any, gathered: Any, carried: Any
) -> Any:
    if decoder[1] != ZERO:
        gather(state, material, cells, grid, grid[0], gathered)
    for p in range(len(cells)):
        for d in range(cells.shape[1]):
            kept = ZERO  # not a sum over zero shares, which would make NaN of infinite velocities
            if decoder[0] != ZERO:
                kept += decoder[0] * velocity[p, d]
            if decoder[1] != ZERO:
                kept += decoder[1] * gathered[p, d]
            carried[p, d] = kept


@jit
def _move_block(
    path: Any, material: Any, gravity: Any, grid: Any, fields: Any, decoder: Any, bounds: Any, carried: Any,
    frame: Any, begin: Any, end: Any, gathered: Any, kept: Any,
) -> Any:  # fmt: skip
    """Fill in the path of a block after a frame, from before it; `gathered` and `kept` (BLOCK, D) are scratch."""
    here, base = path[frame, begin:end], carried[begin:end]
    if frame > 0 and decoder[3] > ZERO:
        base = kept[: end - begin]
        np.subtract(here, path[frame - 1, begin:end], base)
    falls = np.float32(1) if decoder[3] > ZERO else np.float32(frame + 1)
    gather(fields[frame], material[begin:end], here, grid, grid[0], gathered)
    _move(here, base, gathered, gravity, decoder[2] * falls, bounds, path[frame + 1, begin:end])


@jit
def _move(cells: Any, base: Any, gathered: Any, gravity: Any, falls: Any, bounds: Any, out: Any) -> Any:
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


@jit
def confine_all(cells: Any, bounds: Any) -> Any:
    """Confine positions (N, D) in place."""
    for d in range(cells.shape[1]):
        for p in range(len(cells)):
            cells[p, d] = confine(cells[p, d], bounds[0, d], bounds[1, d], bounds[2, d] > ZERO)


@jit_sum
def energy(cells: Any, arrived: Any, before: Any, gravity: Any, mass: Any, ratio: Any) -> Any:
    """Energy of particles at `cells` (n, D) with the steps from `before` to `arrived`, weighted by their mass."""
    total = ZERO
    for d in range(cells.shape[1]):
        fall, wide = gravity[d] * ratio[d] * ratio[d], HALF * ratio[d] * ratio[d]
        for p in range(len(cells)):
            step = arrived[p, d] - before[p, d]
            total += mass[p] * (wide * step * step - cells[p, d] * fall)
    return np.float64(total)


@jit
def propose_frame(
    path: Any, velocity: Any, material: Any, gravity: Any, mass: Any, grid: Any, fields: Any, decoder: Any, bounds: Any,
    ratio: Any, carried: Any, frame: Any, low: Any, high: Any,
) -> Any:  # fmt: skip
    """Fill in the path after a frame as if it were free.

    Returns:
        (5,): the energy that the scene would have if nobody moved; kinetic energy of the particles that gain energy in
        this frame, and of all; what falling takes from the potential energy of those, and of all.
    """
    sums = np.zeros(5)
    dim = path.shape[2]
    scratch, kept = np.empty((BLOCK, dim), np.float32), np.empty((BLOCK, dim), np.float32)
    for begin in range(low, high, BLOCK):
        end = min(begin + BLOCK, high)
        _move_block(path, material, gravity, grid, fields, decoder, bounds, carried, frame, begin, end, scratch, kept)
        for p in range(begin, end):
            kinetic, fall, height, gains = _balance(path, velocity, gravity, ratio, frame, p)
            sums[0] -= mass[p] * height
            sums[2] += mass[p] * kinetic
            sums[4] -= mass[p] * fall
            if gains:
                sums[1] += mass[p] * kinetic
                sums[3] -= mass[p] * fall
    return sums


@jit
def _balance(path: Any, velocity: Any, gravity: Any, ratio: Any, frame: Any, p: Any) -> Any:
    """Of a step: its kinetic energy, the work of gravity, minus the potential before, and whether energy is gained."""
    kinetic, fall, height, gain = ZERO, ZERO, ZERO, ZERO
    for d in range(path.shape[2]):
        here = path[frame, p, d]
        step = (path[frame + 1, p, d] - here) * ratio[d]
        before = (velocity[p, d] if frame == 0 else here - path[frame - 1, p, d]) * ratio[d]
        place, pull = here * ratio[d], gravity[d] * ratio[d]
        kinetic += HALF * step * step
        fall += step * pull
        height += place * pull
        gain += (step - before) * (step + before) * HALF - step * pull - _ROUNDING * abs(place * step)
    return kinetic, fall, height, gain > ZERO


@jit
def shorten_frame(
    path: Any, velocity: Any, gravity: Any, bounds: Any, ratio: Any, frame: Any, factor: Any, only_gainers: Any,
    low: Any, high: Any,
) -> Any:  # fmt: skip
    """Multiply the proposed steps of a frame by a factor, of the particles that gain energy or of all."""
    for p in range(low, high):
        if only_gainers and not _balance(path, velocity, gravity, ratio, frame, p)[3]:
            continue
        for d in range(path.shape[2]):
            here = path[frame, p, d]
            arrived = here + factor * (path[frame + 1, p, d] - here)
            path[frame + 1, p, d] = confine(arrived, bounds[0, d], bounds[1, d], bounds[2, d] > ZERO)


@jit
def fill_gains(path: Any, material: Any, grid: Any, rates: Any, gains: Any, values: Any, low: Any, high: Any) -> Any:
    """Fill in `gains` (m, N, E), the sums of the rates (m, size, M E) that particles meet before each frame's step.

    `values` is a tuple of length E.
    """
    for frame in range(len(rates)):
        here = gains[frame, low:high]
        gather(rates[frame], material[low:high], path[frame, low:high], grid, values, here)
        if frame > 0:
            here += gains[frame - 1, low:high]
