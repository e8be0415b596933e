"""Moving-least-squares material point method in two dimensions.

One substep scatters mass and momentum from the particles to a grid, with the stress as part of an affine momentum
(Hu et al., "A moving least squares material point method with displacement discontinuity and two-way rigid body
coupling", 2018), applies gravity and the walls at the grid's nodes, and gathers velocity and its gradient back (APIC:
Jiang et al., "The affine particle-in-cell method", 2015). Kernels are quadratic B-splines.

Nodes are the centres of square cells of size h that fill the box, and of one more cell around it, so that a particle in
cell i feels the nodes i, i + 1 and i + 2, counted from the outer cell. The wall acts at the centres of the outer and of
the first inner cells. A particle's velocity towards the wall then falls with the square of its distance from the box's
side, and it cannot cross. Walls that hold on to material act at the centres of the second inner cells as well, where
particles then stop; the box's sides are a cell further out.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import DataError
from nmpm.sim.compiled import compiled
from nmpm.sim.materials import Material
from nmpm.sim.materials.base import Array
from nmpm.sim.solid import Solid, slide

REVISION = 1
"""Raised whenever the same preset and seed would give other numbers."""

# Distance from the box's sides, in cells, at which a particle is held back. Float32 can still tell it from the side.
_MARGIN = 1e-4


class Walls(enum.Enum):
    """What the box's sides do with material that leaves them."""

    SEPARATE = "separate"
    """Let it go: they push and brake, and never pull."""

    SLIP = "slip"
    """Hold it, so that it only slides along."""

    OPEN_CORNERS = "slip, open corners"
    """Hold it; but at the very corner, the first node of both walls, along the first axis alone, so that what slides
    down a side is not stopped a cell above the floor. So walls the solver that made DeepMind's recorded water."""


@dataclass(frozen=True)
class Grid:
    """Square cells, cubes in three dimensions, that fill a box.

    Args:
        low: (D,) lower corner of the box, in length.
        size: Side of a cell, in length.
        shape: Cells along each axis.
        friction: Coulomb friction of the walls.
        gravity: (D,) acceleration, in length per second squared.
        walls: How the box's sides treat material.
        solid: Obstacles within the box, if any.
    """

    low: Array
    size: float
    shape: tuple[int, ...]
    friction: float
    gravity: Array
    walls: Walls = Walls.SEPARATE
    solid: Solid | None = None


class State:
    """Particles on the move, N of them in D dimensions, sorted by material.

    Args:
        position: (N, D) in length.
        velocity: (N, D) in length per second.
        groups: Material and number of particles of each group, in the particles' order.
        volume: Area of a particle at rest, or volume in three dimensions.
    """

    def __init__(
        self, position: NDArray[Any], velocity: NDArray[Any], groups: tuple[tuple[Material, int], ...], volume: float
    ) -> None:
        count, dim = position.shape
        self.position = np.array(position, dtype=np.float64, order="C")
        self.velocity = np.array(velocity, dtype=np.float64, order="C")
        self.gradient: Array = np.zeros((count, dim, dim))
        self.strain: Array = _at_rest(groups, dim)
        self.stress: Array = np.zeros((count, dim * (dim + 1) // 2))
        self.volume = volume
        self.mass: Array = np.repeat([m.density * volume for m, _ in groups], [n for _, n in groups])
        ends = np.cumsum([0] + [n for _, n in groups])
        self.parts = tuple((m, slice(a, b)) for (m, _), a, b in zip(groups, ends[:-1], ends[1:], strict=True))


def _at_rest(groups: tuple[tuple[Material, int], ...], dim: int) -> Array:
    """Strains of unstrained particles, as wide as the widest material's; the others leave the last columns alone."""
    width = max(len(material.rest(dim)) for material, _ in groups)
    strain = np.zeros((sum(count for _, count in groups), width))
    first = 0
    for material, count in groups:
        rest = material.rest(dim)
        strain[first : first + count, : len(rest)] = rest
        first += count
    return strain


class Stepper:
    """Advances a state of two dimensions by substeps of one length.

    Args:
        grid: Where the state lives.
        dt: Length of a substep, in seconds.
    """

    def __init__(self, grid: Grid, dt: float) -> None:
        self.grid = grid
        self.dt = dt
        self.held_back = 0
        """Particles held back at the box's sides so far, by the last safety that should never act."""
        self.pushed_out = 0
        """Particles put back to an obstacle's surface so far."""
        self._nodes: Array = np.zeros((*(cells + 2 for cells in grid.shape), len(grid.shape) + 1))
        self._lower = grid.low + _MARGIN * grid.size
        self._upper = grid.low + (np.array(grid.shape) - _MARGIN) * grid.size
        holds = grid.walls is not Walls.SEPARATE
        self._walls = (holds, int(holds), grid.walls is Walls.OPEN_CORNERS)

    def enclose(self, state: State) -> None:
        """Hold particles back at the box's sides and out of obstacles, as every substep does; a state must begin so.

        Raises:
            DataError: if a particle finds no way out of an obstacle.
        """
        np.clip(state.position, self._lower, self._upper, out=state.position)
        if self.grid.solid is not None:
            self.grid.solid.push_out(state.position.copy(), state.position, state.velocity, self._lower, self._upper)
            depth = self.grid.solid.depth(state.position)
            if depth.any():
                worst = int(np.argmax(depth))
                raise DataError(f"Particle {worst} at {state.position[worst].tolist()} is inside an obstacle.")

    def step(self, state: State) -> None:
        """One substep, in place.

        Raises:
            FloatingPointError: if a position is no longer finite.
        """
        grid, dt = self.grid, self.dt
        for material, part in state.parts:
            material.respond(state.strain[part], state.gradient[part], state.stress[part], dt)
        self._to_nodes(state)
        before = None
        if grid.solid is not None:
            before = state.position.copy()
            grid.solid.brake(self._nodes, dt * grid.gravity)
        self._move()
        held_back = self._from_nodes(state)
        if held_back < 0:
            raise FloatingPointError("The state is not finite")
        self.held_back += held_back
        if grid.solid is not None and before is not None:
            self.pushed_out += grid.solid.push_out(before, state.position, state.velocity, self._lower, self._upper)

    def _to_nodes(self, state: State) -> None:
        """Mass and momentum onto the nodes."""
        _scatter(
            self._nodes, self.grid.low, self.grid.size, self.dt * state.volume,
            state.position, state.velocity, state.gradient, state.stress, state.mass,
        )  # fmt: skip

    def _move(self) -> None:
        """Momenta to velocities, under gravity and the walls."""
        _move(self._nodes, self.dt * self.grid.gravity, self.grid.friction, *self._walls)

    def _from_nodes(self, state: State) -> int:
        """Velocities and their gradients from the nodes, and the move they make; see `_gather`."""
        held_back: int = _gather(
            self._nodes, self.grid.low, self.grid.size, self.dt, self._lower, self._upper,
            state.position, state.velocity, state.gradient,
        )  # fmt: skip
        return held_back


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
def _move(nodes: Array, fall: Array, friction: float, holds: bool, inset: int, open_corners: bool) -> None:
    """Momenta to velocities, with gravity's change `fall` and the walls, which reach `inset` nodes further in."""
    nx, ny = nodes.shape[0], nodes.shape[1]
    for i in range(nx):
        for j in range(ny):
            if nodes[i, j, 0] <= 0:
                continue
            u = nodes[i, j, 1] / nodes[i, j, 0] + fall[0]
            v = nodes[i, j, 2] / nodes[i, j, 0] + fall[1]
            # Nodes from the walls' surface, 0 on it; negative within the box.
            deep_x, deep_y = inset + 1 - min(i, nx - 1 - i), inset + 1 - min(j, ny - 1 - j)
            at_x, at_y = deep_x >= 0, deep_y >= 0
            if open_corners and at_x and at_y and min(deep_x, deep_y) == 0:
                at_x, at_y = deep_x >= deep_y, deep_y > deep_x
            if at_x:
                sign = 1.0 if 2 * i < nx else -1.0
                u, v = slide(sign * u, v, friction)
                u = 0.0 if holds else sign * u
            if at_y:
                sign = 1.0 if 2 * j < ny else -1.0
                v, u = slide(sign * v, u, friction)
                v = 0.0 if holds else sign * v
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
