"""Moving-least-squares material point method in two dimensions.

One substep scatters mass and momentum from the particles to a grid, with the stress as part of an affine momentum
(Hu et al., "A moving least squares material point method with displacement discontinuity and two-way rigid body
coupling", 2018), applies gravity and the walls at the grid's nodes, and gathers velocity and its gradient back (APIC:
Jiang et al., "The affine particle-in-cell method", 2015). Kernels are quadratic B-splines.

Nodes are the centres of square cells of size h that fill the box, and of one more cell around it, so that a particle in
cell i feels the nodes i, i + 1 and i + 2, counted from the outer cell. The wall acts at the centres of the outer and of
the first inner cells. A particle's velocity towards the wall then falls with the square of its distance from the box's
side, and it cannot cross.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.sim.compiled import compiled
from nmpm.sim.materials import Material
from nmpm.sim.materials.base import Array

REVISION = 1
"""Raised whenever the same preset and seed would give other numbers."""

# Distance from the box's sides, in cells, at which a particle is held back. Float32 can still tell it from the side.
_MARGIN = 1e-4


@dataclass(frozen=True)
class Grid:
    """Square cells that fill a box.

    Args:
        low: (2,) lower corner of the box, in length.
        size: Side of a cell, in length.
        shape: Cells along each axis.
        friction: Coulomb friction of the walls.
        gravity: (2,) acceleration, in length per second squared.
    """

    low: Array
    size: float
    shape: tuple[int, int]
    friction: float
    gravity: Array


class State:
    """Particles on the move, N of them, sorted by material.

    Args:
        position: (N, 2) in length.
        velocity: (N, 2) in length per second.
        groups: Material and number of particles of each group, in the particles' order.
        volume: Area of a particle at rest.
    """

    def __init__(
        self, position: NDArray[Any], velocity: NDArray[Any], groups: tuple[tuple[Material, int], ...], volume: float
    ) -> None:
        count = len(position)
        self.position = np.array(position, dtype=np.float64, order="C")
        self.velocity = np.array(velocity, dtype=np.float64, order="C")
        self.gradient: Array = np.zeros((count, 2, 2))
        self.strain: Array = np.tile(np.array([1.0, 0.0, 1.0]), (count, 1))
        self.stress: Array = np.zeros((count, 3))
        self.volume = volume
        self.mass: Array = np.repeat([m.density * volume for m, _ in groups], [n for _, n in groups])
        ends = np.cumsum([0] + [n for _, n in groups])
        self.parts = tuple((m, slice(a, b)) for (m, _), a, b in zip(groups, ends[:-1], ends[1:], strict=True))


class Stepper:
    """Advances a state by substeps of one length.

    Args:
        grid: Where the state lives.
        dt: Length of a substep, in seconds.
    """

    def __init__(self, grid: Grid, dt: float) -> None:
        self.grid = grid
        self.dt = dt
        self.held_back = 0
        """Particles held back at the box's sides so far, by the last safety that should never act."""
        self._nodes: Array = np.zeros((grid.shape[0] + 2, grid.shape[1] + 2, 3))
        self._lower = grid.low + _MARGIN * grid.size
        self._upper = grid.low + (np.array(grid.shape) - _MARGIN) * grid.size

    def enclose(self, state: State) -> None:
        """Hold particles back at the box's sides, as every substep does; a state must begin so."""
        np.clip(state.position, self._lower, self._upper, out=state.position)

    def step(self, state: State) -> None:
        """One substep, in place.

        Raises:
            FloatingPointError: if a position is no longer finite.
        """
        grid, nodes, dt = self.grid, self._nodes, self.dt
        for material, part in state.parts:
            material.respond(state.strain[part], state.gradient[part], state.stress[part], dt)
        _scatter(
            nodes, grid.low, grid.size, dt * state.volume,
            state.position, state.velocity, state.gradient, state.stress, state.mass,
        )  # fmt: skip
        _move(nodes, dt * grid.gravity, grid.friction)
        held_back = _gather(
            nodes, grid.low, grid.size, dt, self._lower, self._upper, state.position, state.velocity, state.gradient
        )
        if held_back < 0:
            raise FloatingPointError("The state is not finite")
        self.held_back += held_back


@compiled
def _scatter(
    nodes: Array,
    low: Array,
    size: float,
    impulse: float,
    position: Array,
    velocity: Array,
    gradient: Array,
    stress: Array,
    mass: Array,
) -> None:
    """Mass and momentum of the particles, summed at the nodes; impulse is substep length × particle area."""
    nodes[:] = 0.0
    scale = -4.0 * impulse / (size * size)
    for p in range(position.shape[0]):
        m = mass[p]
        x, y = (position[p, 0] - low[0]) / size, (position[p, 1] - low[1]) / size
        i, j = int(x), int(y)
        fx, fy = x - i + 0.5, y - j + 0.5
        wx = (0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2)
        wy = (0.5 * (1.5 - fy) ** 2, 0.75 - (fy - 1.0) ** 2, 0.5 * (fy - 0.5) ** 2)
        # Affine momentum per cell: what one cell's distance adds to the momentum at a node.
        axx = size * (scale * stress[p, 0] + m * gradient[p, 0, 0])
        axy = size * (scale * stress[p, 1] + m * gradient[p, 0, 1])
        ayx = size * (scale * stress[p, 1] + m * gradient[p, 1, 0])
        ayy = size * (scale * stress[p, 2] + m * gradient[p, 1, 1])
        bx = m * velocity[p, 0] - axx * fx - axy * fy
        by = m * velocity[p, 1] - ayx * fx - ayy * fy
        for a in range(3):
            for b in range(3):
                weight = wx[a] * wy[b]
                nodes[i + a, j + b, 0] += weight * m
                nodes[i + a, j + b, 1] += weight * (bx + axx * a + axy * b)
                nodes[i + a, j + b, 2] += weight * (by + ayx * a + ayy * b)


@compiled
def _slide(normal: float, tangential: float, friction: float) -> tuple[float, float]:
    """Velocity at a wall, which takes what goes into it (normal < 0) and brakes what slides along."""
    if normal >= 0:
        return normal, tangential
    left = max(0.0, abs(tangential) + friction * normal)
    return 0.0, left if tangential > 0 else -left


@compiled
def _move(nodes: Array, fall: Array, friction: float) -> None:
    """Momenta to velocities, with gravity's change `fall` and the walls."""
    nx, ny = nodes.shape[0], nodes.shape[1]
    for i in range(nx):
        for j in range(ny):
            if nodes[i, j, 0] <= 0:
                continue
            u = nodes[i, j, 1] / nodes[i, j, 0] + fall[0]
            v = nodes[i, j, 2] / nodes[i, j, 0] + fall[1]
            if i <= 1:
                u, v = _slide(u, v, friction)
            elif i >= nx - 2:
                u, v = _slide(-u, v, friction)
                u = -u
            if j <= 1:
                v, u = _slide(v, u, friction)
            elif j >= ny - 2:
                v, u = _slide(-v, u, friction)
                v = -v
            nodes[i, j, 1], nodes[i, j, 2] = u, v


@compiled
def _gather(
    nodes: Array,
    low: Array,
    size: float,
    dt: float,
    lower: Array,
    upper: Array,
    position: Array,
    velocity: Array,
    gradient: Array,
) -> int:
    """Velocities, their gradients and the move they make; how many were held back, -1 if a position is not finite."""
    held_back = 0
    for p in range(position.shape[0]):
        x, y = (position[p, 0] - low[0]) / size, (position[p, 1] - low[1]) / size
        i, j = int(x), int(y)
        fx, fy = x - i + 0.5, y - j + 0.5
        wx = (0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2)
        wy = (0.5 * (1.5 - fy) ** 2, 0.75 - (fy - 1.0) ** 2, 0.5 * (fy - 0.5) ** 2)
        u = v = uxx = uxy = vxx = vxy = 0.0
        for a in range(3):
            for b in range(3):
                weight = wx[a] * wy[b]
                wu, wv = weight * nodes[i + a, j + b, 1], weight * nodes[i + a, j + b, 2]
                u += wu
                v += wv
                uxx += wu * a
                uxy += wu * b
                vxx += wv * a
                vxy += wv * b
        velocity[p, 0], velocity[p, 1] = u, v
        gradient[p, 0, 0], gradient[p, 0, 1] = 4 / size * (uxx - fx * u), 4 / size * (uxy - fy * u)
        gradient[p, 1, 0], gradient[p, 1, 1] = 4 / size * (vxx - fx * v), 4 / size * (vxy - fy * v)
        x, y = position[p, 0] + dt * u, position[p, 1] + dt * v
        if not (lower[0] <= x <= upper[0] and lower[1] <= y <= upper[1]):
            if not (np.isfinite(x) and np.isfinite(y)):
                return -1
            x, y = min(max(x, lower[0]), upper[0]), min(max(y, lower[1]), upper[1])
            held_back += 1
        position[p, 0], position[p, 1] = x, y
    return held_back
