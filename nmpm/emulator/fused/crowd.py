"""A scene's path with its overfull cells spread, by the kernels of `crowding`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from nmpm._support.threads import map_ranges, split
from nmpm.emulator.fused.crowding import count_particles, drift, push, spread_energies
from nmpm.emulator.fused.flight import weigh
from nmpm.emulator.fused.path import ROUNDING
from nmpm.emulator.fused.plan import Array, Plan
from nmpm.emulator.fused.surroundings import Surroundings

_CHUNK = 2**14  # particles that a thread treats at once
_COUNTED = 2**16  # of those that are counted: each chunk has a grid of its own
_NONE = np.empty(0, np.float32)


@dataclass(frozen=True)
class CrowdArrays:
    """One scene's path and where it started; shapes as in `crowding.drift` and `crowding.spread_energies`."""

    cells: Array
    material: Array
    mask: Array
    gravity: Array
    path: Array


def spread_scene(
    start: CrowdArrays, plan: Plan, around: Surroundings, budget: float | None, spread: Array, threads: int
) -> None:
    """Fill in the path of a scene with its overfull cells spread, as far as its energy allows.

    Args:
        start: The path.
        plan: Of the emulator.
        around: The scene's solids, with a room.
        budget: Energy that no frame may exceed; None for no such limit.
        spread: (m, N, D), is filled.
        threads: How many work.
    """
    flow = _find_flow(start, plan, around, threads)
    if flow is None:
        spread[:] = start.path
        return
    ranges = split(len(start.cells), _CHUNK)
    share = around.share if plan.solids else _NONE
    move = partial(drift, flow, start.path, start.mask, share, plan.shape, plan.wraps, plan.limits, spread)
    map_ranges(move, ranges, threads)
    if budget is not None:
        part = _affordable_share(start, plan, budget, spread, threads)
        if part < 1:
            spread[:] = start.path + np.float32(part) * (spread - start.path)


def _find_flow(start: CrowdArrays, plan: Plan, around: Surroundings, threads: int) -> Array | None:
    """(size, D) displacements at the nodes; None where no cell is overfull."""
    if around.room is None or not len(start.cells):
        return None
    known, size = around.room, len(around.room.room)
    count = partial(count_particles, start.path[-1], start.mask, plan.shape, plan.wraps)
    parts = map_ranges(count, split(len(start.cells), max(_COUNTED, 4 * size)), threads)
    counts = parts[0]
    for part in parts[1:]:
        counts += part
    flow = np.empty((size, plan.dim), np.float32)
    particle = np.float32(plan.particle_volume / plan.density_cap)
    found = push(counts.reshape(-1), particle, known.room, known.faces, known.inverse, plan.shape, flow)
    return flow if found else None


def _affordable_share(start: CrowdArrays, plan: Plan, budget: float, spread: Array, threads: int) -> float:
    """The part of the way from the path to the spread one that no frame's energy forbids.

    As `nmpm.emulator.constraints.affordable_share`.
    """
    share = np.empty(len(start.cells), np.float32)
    weigh(start.material, start.mask, plan.masses, share)

    def energies(path: Array) -> Array:
        find = partial(spread_energies, start.cells, start.path, path, start.gravity, share, plan.ratio)
        parts = map_ranges(find, split(len(start.cells), _CHUNK), threads)
        return np.asarray(np.sum(parts, axis=0))

    after = energies(spread)
    exceeds = after > budget + ROUNDING * abs(budget)
    if not exceeds.any():
        return 1.0
    before = energies(start.path)
    rise, room = after[exceeds] - before[exceeds], np.maximum(budget - before[exceeds], 0)
    return float(np.where(rise > 0, room / np.where(rise > 0, rise, 1), 0).min())
