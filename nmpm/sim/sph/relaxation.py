"""Spreading particles evenly over a closed box."""

from __future__ import annotations

import numpy as np

from nmpm.sim.arrays import Array
from nmpm.sim.sph import sums
from nmpm.sim.sph.kernel import SUPPORT
from nmpm.sim.sph.neighbours import CellGrid, PairFinder, Pairs
from nmpm.sim.sph.walls import SolidBoundary

# Way along the gradient of particle concentration in a sweep, in spacings squared, and its limit in spacings.
_STEP = 0.1
_LIMIT = 0.1


def relax(position: Array, box: tuple[tuple[float, float], tuple[float, float]], spacing: float, sweeps: int) -> Array:
    """Move particles, sweep by sweep, from where they are dense to where they are not.

    A sweep shifts each by −D ∇C, where C is the concentration Σ V W (Lind, Xu, Stansby & Rogers 2012, equation 24),
    which is what a constant background pressure does in Adami, Hu & Adams (2013).

    Args:
        position: (N, 2); those outside of the box are moved to its sides first.
        box: (lower, upper) along x and y, in length, with dummy particles around it.
        spacing: Of the particles, in length.
        sweeps: How many.
    """
    boundary = SolidBoundary(box, (), spacing)
    grid = CellGrid.covering(boundary.position.min(0), boundary.position.max(0), SUPPORT * spacing)
    finder, wall_finder = PairFinder(grid), PairFinder(grid)
    order, wall_starts = grid.sort_by_cell(*np.ascontiguousarray(boundary.position.T))
    wall_x, wall_y = np.ascontiguousarray(boundary.position[order].T)
    x, y = np.ascontiguousarray(position.T)
    identity, still = np.arange(len(x)), np.zeros_like(x)
    for _ in range(sweeps):
        boundary.clamp(x, y, still, still)
        order, starts = grid.sort_by_cell(x, y)
        x, y, identity = x[order], y[order], identity[order]
        shift = _concentration_gradient(x, y, finder.pairs_within(x, y, starts), spacing)
        shift += _wall_gradient(
            x, y, wall_x, wall_y, wall_finder.pairs_between(x, y, wall_x, wall_y, wall_starts), spacing
        )
        shift *= -_STEP * spacing**2
        shift *= np.minimum(1.0, _LIMIT * spacing / np.maximum(np.hypot(*shift), 1e-30))
        x, y = x + shift[0], y + shift[1]
    boundary.clamp(x, y, still, still)
    spread = np.empty((len(x), 2))
    spread[identity] = np.stack([x, y], -1)
    return spread


def _concentration_gradient(x: Array, y: Array, pairs: Pairs, spacing: float) -> Array:
    dx, dy, f = np.empty((3, len(pairs[0])))
    sums.pair_geometry(x, y, *pairs, spacing, dx, dy, f)
    area = spacing**2
    weights = [(f * d * area) for d in (dx, dy)]
    return np.stack(
        [np.bincount(pairs[0], w, len(x)) - np.bincount(pairs[1], w, len(x)) for w in weights],
    )


def _wall_gradient(x: Array, y: Array, wall_x: Array, wall_y: Array, pairs: Pairs, spacing: float) -> Array:
    dx, dy, f, w = np.empty((4, len(pairs[0])))
    sums.wall_geometry(x, y, wall_x, wall_y, *pairs, spacing, dx, dy, f, w)
    return np.stack([np.bincount(pairs[0], f * d * spacing**2, len(x)) for d in (dx, dy)])
