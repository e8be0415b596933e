"""Kernels that keep a frame within an energy, as `nmpm.emulator.constraints.affordable` does.

`propose` moves particles a frame on and returns the sums that decide; `shorten` takes steps back in part.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm.emulator.fused.flight import confine, move, subtract
from nmpm.transfer.fused.gather import gather

ZERO, HALF = np.float32(0), np.float32(0.5)
_BLOCK = 512
_ROUNDING = np.float32(4 * np.finfo(np.float32).eps)


@jit
def propose(
    cells: Any,
    velocity: Any,
    material: Any,
    gravity: Any,
    share: Any,
    grid: Any,
    fields: Any,
    decoder: Any,
    bounds: Any,
    ratio: Any,
    carried: Any,
    path: Any,
    frame: Any,
    low: Any,
    high: Any,
) -> Any:
    """Fill in a frame of the path as if it were free.

    Returns:
        (5,): the energy that the scene would have if nobody moved; kinetic energy of the particles that gain energy in
        this frame, and of all; what falling takes from the potential energy of those, and of all.
    """
    sums = np.zeros(5)
    dim = cells.shape[1]
    scratch, kept = np.empty((_BLOCK, dim), np.float32), np.empty((_BLOCK, dim), np.float32)
    for begin in range(low, high, _BLOCK):
        end = min(begin + _BLOCK, high)
        here = path[frame - 1, begin:end] if frame > 0 else cells[begin:end]
        base = carried[begin:end]
        if frame > 0 and decoder[3] > ZERO:
            subtract(here, path[frame - 2, begin:end] if frame > 1 else cells[begin:end], kept)
            base = kept[: end - begin]
        falls = np.float32(1) if decoder[3] > ZERO else np.float32(frame + 1)
        gather(fields[frame], material[begin:end], here, grid[0], grid[1], grid[2], scratch)
        move(here, base, scratch, gravity, decoder[2] * falls, bounds, path[frame, begin:end])
        for p in range(begin, end):
            kinetic, fall, height, gains = _balance(cells, velocity, gravity, ratio, path, frame, p)
            sums[0] -= share[p] * height
            sums[2] += share[p] * kinetic
            sums[4] -= share[p] * fall
            if gains:
                sums[1] += share[p] * kinetic
                sums[3] -= share[p] * fall
    return sums


@jit
def _balance(cells: Any, velocity: Any, gravity: Any, ratio: Any, path: Any, frame: Any, p: Any) -> Any:
    """Of a step: its kinetic energy, the work of gravity, minus the potential before, and whether energy is gained."""
    kinetic, fall, height, gain = ZERO, ZERO, ZERO, ZERO
    for d in range(cells.shape[1]):
        here = path[frame - 1, p, d] if frame > 0 else cells[p, d]
        step = (path[frame, p, d] - here) * ratio[d]
        if frame == 0:
            before = velocity[p, d] * ratio[d]
        else:
            before = (here - (path[frame - 2, p, d] if frame > 1 else cells[p, d])) * ratio[d]
        place, pull = here * ratio[d], gravity[d] * ratio[d]
        kinetic += HALF * step * step
        fall += step * pull
        height += place * pull
        gain += (step - before) * (step + before) * HALF - step * pull - _ROUNDING * abs(place * step)
    return kinetic, fall, height, gain > ZERO


@jit
def shorten(
    cells: Any,
    velocity: Any,
    gravity: Any,
    bounds: Any,
    ratio: Any,
    path: Any,
    frame: Any,
    factor: Any,
    only_gainers: Any,
    low: Any,
    high: Any,
) -> Any:
    """Multiply the proposed steps of a frame by a factor, of the particles that gain energy or of all."""
    for p in range(low, high):
        if only_gainers and not _balance(cells, velocity, gravity, ratio, path, frame, p)[3]:
            continue
        for d in range(cells.shape[1]):
            here = path[frame - 1, p, d] if frame > 0 else cells[p, d]
            arrived = here + factor * (path[frame, p, d] - here)
            path[frame, p, d] = confine(arrived, bounds[0, d], bounds[1, d], bounds[2, d] > ZERO)
