"""The paths of a batch's particles through a bundle, by the kernels of this package."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from nmpm._support.threads import map_ranges, split
from nmpm.emulator.constraints import FREE_FALL_SHARE
from nmpm.emulator.fused import contact
from nmpm.emulator.fused.flight import first_excess, fly, weigh
from nmpm.emulator.fused.limit import propose, shorten
from nmpm.emulator.fused.plan import Array, Plan
from nmpm.emulator.fused.support import rest, support
from nmpm.emulator.fused.surroundings import Surroundings

_CHUNK = 2**14  # particles that a thread treats at once; sums do not depend on the number of threads
_MAX_PIECES = 64
_TINY = float(np.finfo(np.float32).tiny)
ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Share of an energy by which sums of float32 may exceed it."""


@dataclass(frozen=True)
class SceneArrays:
    """One scene of an `emulator.bundle.BundleStart`; shapes as in `flight.fly`."""

    cells: Array
    velocity: Array
    material: Array
    mask: Array
    gravity: Array
    state: Array
    fields: Array


def fly_scene(start: SceneArrays, plan: Plan, budget: float | None, path: Array, threads: int) -> None:
    """Fill in the path (m, N, D) of a scene: free, or within an energy."""
    count = len(start.cells)
    share = np.empty(count if budget is not None else 0, np.float32)
    if budget is not None:
        weigh(start.material, start.mask, plan.masses, share)
    carried = np.empty_like(start.cells)
    ranges = split(count, _CHUNK)
    free = partial(
        fly, start.cells, start.velocity, start.material, start.gravity, share, plan.gather_grid, start.state,
        start.fields, plan.shares, plan.limits, plan.ratio, carried, path,
    )  # fmt: skip
    energies = map_ranges(free, ranges, threads)
    if budget is not None and energies:
        first = first_excess(sum(energies[1:], energies[0]), budget + ROUNDING * abs(budget))
        if first < len(path):
            _limit(start, plan, budget, share, carried, first, path, threads)


def _limit(
    start: SceneArrays,
    plan: Plan,
    budget: float,
    share: Array,
    carried: Array,
    first: int,
    path: Array,
    threads: int,
) -> None:
    """Redo a path's frames from the first one that exceeds the energy, each within it."""
    ranges = split(len(start.cells), _CHUNK)
    for frame in range(first, len(path)):
        move = partial(
            propose, start.cells, start.velocity, start.material, start.gravity, share, plan.gather_grid, start.fields,
            plan.shares, plan.limits, plan.ratio, carried, path, frame,
        )  # fmt: skip
        factor, only_gainers = _affordable(sum(map_ranges(move, ranges, threads)).tolist(), budget)
        if factor < 1:
            take_back = partial(
                shorten, start.cells, start.velocity, start.gravity, plan.limits, plan.ratio, path, frame,
                np.float32(factor), only_gainers,
            )  # fmt: skip
            map_ranges(take_back, ranges, threads)


def _affordable(sums: list[float], budget: float) -> tuple[float, bool]:
    """The factor for steps that keeps the energy, and whether it is for those alone that gain energy.

    As `nmpm.emulator.constraints.affordable`, from the sums of `limit.propose`.
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


def rest_scene(start: SceneArrays, plan: Plan, share: Array, path: Array, threads: int) -> None:
    """Leave resting particles of a scene where they started if something holds them up; let the others fall.

    Args:
        start: Where the bundle starts.
        plan: Of the emulator.
        share: (size,) of each cell's room that is obstacle; empty where there are no obstacles.
        path: (m, N, D), is changed.
        threads: How many work.
    """
    held, grid = np.empty(len(start.state), np.bool_), (plan.shape, plan.wraps)
    support(start.state, plan.volume_channels, share, start.gravity, grid, plan.floor_rows, held)
    speed = np.float32(plan.rest_speed)
    still = partial(
        rest, start.cells, path, start.gravity, speed, np.float32(FREE_FALL_SHARE), share, grid, held, plan.limits
    )  # fmt: skip
    map_ranges(still, split(len(start.cells), _CHUNK), threads)


def clear_of_obstacles(start: SceneArrays, plan: Plan, around: Surroundings, path: Array, threads: int) -> None:
    """Keep a scene's path clear of obstacles, and within the bounds.

    Args:
        start: Where the bundle starts.
        plan: Of the emulator.
        around: Its obstacles.
        path: (m, N, D), is changed.
        threads: How many work.
    """
    ranges, grid, share = split(len(start.cells), _CHUNK), (plan.shape, plan.wraps), around.share
    longest = map_ranges(partial(contact.longest_step, start.cells, path, start.mask), ranges, threads)
    pieces = _count_pieces(longest)
    marks = np.empty(len(start.cells), np.int8)
    find = partial(contact.mark, start.cells, path, start.mask, share, around.clearance, grid, pieces, marks)
    if not sum(map_ranges(find, ranges, threads)):
        return
    rows = np.flatnonzero(marks)
    free = np.empty(len(rows), np.int64)
    place, along = np.empty((2, len(rows), plan.dim), np.float32)
    rest = contact.follow(start.cells, path, share, grid, pieces, rows, free, place, along)
    contact.slide(path, share, grid, plan.limits, pieces, _count_pieces([rest]), rows, free, place, along)
    stuck = np.flatnonzero(marks == contact.STUCK)
    if len(stuck):
        contact.push_out(start.cells, path, share, grid, plan.limits, stuck)


def _count_pieces(lengths: list[float]) -> int:
    """Pieces of at most half a cell in the longest of these lengths."""
    return min(max(math.ceil(max(lengths, default=0.0) / contact.PIECE), 1), _MAX_PIECES)
