"""One substep of the moving-least-squares material point method, in any dimension.

It scatters mass and momentum from the particles to a grid, with the stress as part of an affine momentum (Hu et al.,
"A moving least squares material point method with displacement discontinuity and two-way rigid body coupling", 2018),
applies gravity and the walls at the grid's nodes, and gathers velocity and its gradient back (APIC: Jiang et al., "The
affine particle-in-cell method", 2015). Kernels are quadratic B-splines.

Nodes are the centres of square cells of size h that fill the box, and of one more cell around it, so that a particle in
cell i feels the nodes i, i + 1 and i + 2, counted from the outer cell. The wall acts at the centres of the outer and of
the first inner cells. A particle's velocity towards the wall then falls with the square of its distance from the box's
side, and it cannot cross. Walls that hold on to material act at the centres of the second inner cells as well, where
particles then stop; the box's sides are a cell further out.

Nodes have mass and momentum, (X, Y, D + 1) or (X, Y, Z, D + 1). Only those in a window (2, D) around the particles are
cleared and updated. In three dimensions each of two or three walls that meet acts in turn; friction brakes the velocity
along a wall as a vector.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
from nmpm.errors import ConfigError, DataError, UnstableError
from nmpm.sim.mpm.materials import Material
from nmpm.sim.mpm.obstacle_field import ObstacleField, slide
from nmpm.sim.state import Array

Motion = tuple[Array, Array, Array]
"""Position (N, D), velocity (N, D) and velocity gradient (N, D, D) of the particles."""


class Cells(NamedTuple):
    """The box's lower corner, the side of its cells, and the least and largest position of a particle."""

    low: Array
    size: float
    lower: Array
    upper: Array


@jit
def scatter_2d(
    nodes: Array, window: NDArray[np.int64], cells: Cells, impulse: float, motion: Motion, stress: Array, mass: Array
) -> None:
    """Mass and momentum of the particles, summed at the nodes; impulse is substep length × particle area."""
    (position, velocity, gradient), low, size = motion, cells.low, cells.size
    nodes[window[0, 0] : window[1, 0], window[0, 1] : window[1, 1]] = 0.0
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


@jit
def update_nodes_2d(
    nodes: Array,
    window: NDArray[np.int64],
    fall: Array,
    friction: float,
    holds: bool,
    inset: int,
    open_corners: bool,
) -> None:
    """Momenta to velocities, with gravity's change `fall` and the walls, which reach `inset` nodes further in."""
    nx, ny = nodes.shape[0], nodes.shape[1]
    for i in range(window[0, 0], window[1, 0]):
        for j in range(window[0, 1], window[1, 1]):
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


@jit
def gather_2d(nodes: Array, cells: Cells, dt: float, motion: Motion) -> int:
    """Velocities, their gradients and the move; returns how many were clamped, or -1 if a position is not finite."""
    (position, velocity, gradient), (low, size, lower, upper) = motion, cells
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


@jit
def _weights(offset: float) -> tuple[float, float, float]:
    """Quadratic B-spline weights of three nodes; the particle is `offset` cells from the first."""
    return 0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1.0) ** 2, 0.5 * (offset - 0.5) ** 2


@jit
def scatter_3d(
    nodes: Array, window: NDArray[np.int64], cells: Cells, impulse: float, motion: Motion, stress: Array, mass: Array
) -> None:
    """Mass and momentum of the particles, summed at the nodes; impulse is substep length × particle volume."""
    (position, velocity, gradient), low, size = motion, cells.low, cells.size
    first, last = window[0], window[1]
    for i in range(first[0], last[0]):
        for j in range(first[1], last[1]):
            nodes[i, j, first[2] : last[2]] = 0.0
    scale = -4.0 * impulse / (size * size)
    for p in range(position.shape[0]):
        m = mass[p]
        x, y, z = (position[p, 0] - low[0]) / size, (position[p, 1] - low[1]) / size, (position[p, 2] - low[2]) / size
        i, j, k = int(x), int(y), int(z)
        fx, fy, fz = x - i + 0.5, y - j + 0.5, z - k + 0.5
        wx, wy, wz = _weights(fx), _weights(fy), _weights(fz)
        # Affine momentum per cell: what one cell's distance adds to the momentum at a node.
        xx = size * (scale * stress[p, 0] + m * gradient[p, 0, 0])
        xy = size * (scale * stress[p, 1] + m * gradient[p, 0, 1])
        xz = size * (scale * stress[p, 2] + m * gradient[p, 0, 2])
        yx = size * (scale * stress[p, 1] + m * gradient[p, 1, 0])
        yy = size * (scale * stress[p, 3] + m * gradient[p, 1, 1])
        yz = size * (scale * stress[p, 4] + m * gradient[p, 1, 2])
        zx = size * (scale * stress[p, 2] + m * gradient[p, 2, 0])
        zy = size * (scale * stress[p, 4] + m * gradient[p, 2, 1])
        zz = size * (scale * stress[p, 5] + m * gradient[p, 2, 2])
        bx = m * velocity[p, 0] - xx * fx - xy * fy - xz * fz
        by = m * velocity[p, 1] - yx * fx - yy * fy - yz * fz
        bz = m * velocity[p, 2] - zx * fx - zy * fy - zz * fz
        for a in range(3):
            for b in range(3):
                wab = wx[a] * wy[b]
                cx, cy, cz = bx + xx * a + xy * b, by + yx * a + yy * b, bz + zx * a + zy * b
                for c in range(3):
                    weight = wab * wz[c]
                    nodes[i + a, j + b, k + c, 0] += weight * m
                    nodes[i + a, j + b, k + c, 1] += weight * (cx + xz * c)
                    nodes[i + a, j + b, k + c, 2] += weight * (cy + yz * c)
                    nodes[i + a, j + b, k + c, 3] += weight * (cz + zz * c)


@jit
def _slide_along_wall(normal: float, one: float, other: float, friction: float) -> tuple[float, float, float]:
    """Velocity after contact with a wall: none into it (normal < 0), and Coulomb friction along it."""
    if normal >= 0:
        return normal, one, other
    along = math.sqrt(one * one + other * other)
    left = max(0.0, along + friction * normal) / along if along > 0 else 0.0
    return 0.0, left * one, left * other


@jit
def update_nodes_3d(
    nodes: Array,
    window: NDArray[np.int64],
    fall: Array,
    friction: float,
    holds: bool,
    inset: int,
    open_corners: bool,  # noqa: ARG001  # (in two dimensions only)
) -> None:
    """Momenta to velocities, with gravity's change `fall` and the walls, which reach `inset` nodes further in."""
    first, last = window[0], window[1]
    nx, ny, nz = nodes.shape[0], nodes.shape[1], nodes.shape[2]
    for i in range(first[0], last[0]):
        at_x = min(i, nx - 1 - i) <= inset + 1
        for j in range(first[1], last[1]):
            at_y = min(j, ny - 1 - j) <= inset + 1
            for k in range(first[2], last[2]):
                if nodes[i, j, k, 0] <= 0:
                    continue
                u = nodes[i, j, k, 1] / nodes[i, j, k, 0] + fall[0]
                v = nodes[i, j, k, 2] / nodes[i, j, k, 0] + fall[1]
                w = nodes[i, j, k, 3] / nodes[i, j, k, 0] + fall[2]
                if at_x:
                    sign = 1.0 if 2 * i < nx else -1.0
                    u, v, w = _slide_along_wall(sign * u, v, w, friction)
                    u = 0.0 if holds else sign * u
                if at_y:
                    sign = 1.0 if 2 * j < ny else -1.0
                    v, u, w = _slide_along_wall(sign * v, u, w, friction)
                    v = 0.0 if holds else sign * v
                if min(k, nz - 1 - k) <= inset + 1:
                    sign = 1.0 if 2 * k < nz else -1.0
                    w, u, v = _slide_along_wall(sign * w, u, v, friction)
                    w = 0.0 if holds else sign * w
                nodes[i, j, k, 1], nodes[i, j, k, 2], nodes[i, j, k, 3] = u, v, w


@jit
def gather_3d(nodes: Array, cells: Cells, dt: float, motion: Motion) -> int:
    """Velocities, their gradients and the move; returns how many were clamped, or -1 if a position is not finite."""
    (position, velocity, gradient), (low, size, lower, upper) = motion, cells
    held_back = 0
    for p in range(position.shape[0]):
        x, y, z = (position[p, 0] - low[0]) / size, (position[p, 1] - low[1]) / size, (position[p, 2] - low[2]) / size
        i, j, k = int(x), int(y), int(z)
        fx, fy, fz = x - i + 0.5, y - j + 0.5, z - k + 0.5
        wx, wy, (w0, w1, w2) = _weights(fx), _weights(fy), _weights(fz)
        inside = True
        for axis in range(3):
            flow = along_x = along_y = along_z = 0.0
            for a in range(3):
                for b in range(3):
                    weight = wx[a] * wy[b]
                    middle = w1 * nodes[i + a, j + b, k + 1, axis + 1]
                    upper_part = w2 * nodes[i + a, j + b, k + 2, axis + 1]
                    line = weight * (w0 * nodes[i + a, j + b, k, axis + 1] + middle + upper_part)
                    flow += line
                    along_x += line * a
                    along_y += line * b
                    along_z += weight * (middle + 2 * upper_part)
            velocity[p, axis] = flow
            gradient[p, axis, 0] = 4 / size * (along_x - fx * flow)
            gradient[p, axis, 1] = 4 / size * (along_y - fy * flow)
            gradient[p, axis, 2] = 4 / size * (along_z - fz * flow)
            moved = position[p, axis] + dt * flow
            if not (lower[axis] <= moved <= upper[axis]):
                if not np.isfinite(moved):
                    return -1
                moved = min(max(moved, lower[axis]), upper[axis])
                inside = False
            position[p, axis] = moved
        if not inside:
            held_back += 1
    return held_back


# Distance from the box's sides, in cells, at which a particle is clamped. Float32 can still tell it from the side.
_MARGIN = 1e-4


class Walls(enum.Enum):
    """What the box's sides do with material that moves away from them."""

    SEPARATE = "separate"
    """Let it go: they push and brake, and never pull."""

    SLIP = "slip"
    """Hold it, so that it only slides along."""

    OPEN_CORNERS = "slip, open corners"
    """Hold it; but at the very corner, the first node of both walls, along the first axis alone, so that material that
    slides down a side is not stopped a cell above the floor. The solver of DeepMind's recorded water does so."""


@dataclass(frozen=True)
class MpmGrid:
    """Square cells, cubes in three dimensions, that fill a box.

    Args:
        low: (D,) lower corner of the box, in length.
        size: Side of a cell, in length.
        shape: Cells along each axis.
        friction: Coulomb friction of the walls.
        gravity: (D,) acceleration, in length per second squared.
        walls: How the box's sides treat material.
        obstacles: Within the box; None without.
    """

    low: Array
    size: float
    shape: tuple[int, ...]
    friction: float
    gravity: Array
    walls: Walls = Walls.SEPARATE
    obstacles: ObstacleField | None = None


class MpmParticles:
    """N moving particles in D dimensions, sorted by material; a substep changes them in place.

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
        numbers = [number for _, number in groups]
        self.position = np.array(position, dtype=np.float64, order="C")
        self.velocity = np.array(velocity, dtype=np.float64, order="C")
        self.gradient: Array = np.zeros((count, dim, dim))
        # As wide as the widest material's; the other materials do not use the last columns.
        rests = [material.rest(dim) for material, _ in groups]
        padded = [rest + (0.0,) * (max(map(len, rests)) - len(rest)) for rest in rests]
        self.strain: Array = np.repeat(np.array(padded), numbers, axis=0)
        self.stress: Array = np.zeros((count, dim * (dim + 1) // 2))
        self.volume = volume
        self.mass: Array = np.repeat([material.density * volume for material, _ in groups], numbers)
        ends = np.cumsum([0, *numbers])
        self.parts = tuple((m, slice(a, b)) for (m, _), a, b in zip(groups, ends[:-1], ends[1:], strict=True))
        """Each material with the slice of its particles."""


class MpmStepper:
    """Advances particles by substeps of one length.

    Args:
        grid: On which they move.
        dt: Length of a substep, in seconds.

    Raises:
        ConfigError: if the grid has three dimensions, and open corners.
    """

    def __init__(self, grid: MpmGrid, dt: float) -> None:
        dim, in_corners = len(grid.shape), grid.walls is Walls.OPEN_CORNERS
        if dim == 3 and in_corners:
            raise ConfigError("Open corners are implemented in two dimensions, not in three.")
        self.grid = grid
        self.dt = dt
        self.held_back = 0
        """Particles clamped at the box's sides so far; the walls should make this unnecessary."""
        self.pushed_out = 0
        """Particles moved back to an obstacle's surface so far."""
        flat, deep = (scatter_2d, update_nodes_2d, gather_2d), (scatter_3d, update_nodes_3d, gather_3d)
        self._scatter, self._update_nodes, self._gather = flat if dim == 2 else deep
        self._nodes: Array = np.zeros((*(cells + 2 for cells in grid.shape), dim + 1))
        self._window: NDArray[np.int64] = np.zeros((2, dim), np.int64)
        lower = grid.low + _MARGIN * grid.size
        upper = grid.low + (np.array(grid.shape) - _MARGIN) * grid.size
        self._cells = Cells(grid.low, grid.size, lower, upper)
        holds = grid.walls is not Walls.SEPARATE
        self._walls = (holds, int(holds), in_corners)

    def enclose(self, particles: MpmParticles) -> None:
        """Clamp particles to the box and push them out of obstacles; call it once before the first step.

        Raises:
            DataError: if a particle cannot be pushed out of an obstacle.
        """
        lower, upper = self._cells.lower, self._cells.upper
        np.clip(particles.position, lower, upper, out=particles.position)
        obstacles = self.grid.obstacles
        if obstacles is not None:
            obstacles.push_out(particles.position.copy(), particles.position, particles.velocity, lower, upper)
            depth = obstacles.depth(particles.position)
            if depth.any():
                worst = int(np.argmax(depth))
                raise DataError(f"Particle {worst} at {particles.position[worst].tolist()} is inside an obstacle.")

    def step(self, particles: MpmParticles) -> None:
        """One substep, in place.

        Raises:
            FloatingPointError: if a position is no longer finite.
        """
        grid, dt, nodes, window = self.grid, self.dt, self._nodes, self._window
        for material, part in particles.parts:
            material.respond(particles.strain[part], particles.gradient[part], particles.stress[part], dt)
        position, velocity = particles.position, particles.velocity
        motion = position, velocity, particles.gradient
        _find_window(position, grid.low, grid.size, window)
        self._scatter(nodes, window, self._cells, dt * particles.volume, motion, particles.stress, particles.mass)
        before = None
        if grid.obstacles is not None:
            before = position.copy()
            grid.obstacles.brake(nodes, dt * grid.gravity)
        self._update_nodes(nodes, window, dt * grid.gravity, grid.friction, *self._walls)
        held_back = self._gather(nodes, self._cells, dt, motion)
        if held_back < 0:
            raise FloatingPointError("The state is not finite")
        self.held_back += held_back
        if grid.obstacles is not None and before is not None:
            self.pushed_out += grid.obstacles.push_out(before, position, velocity, self._cells.lower, self._cells.upper)

    def advance_frame(self, particles: MpmParticles, substeps: int, frame: int) -> None:
        """The substeps of a frame, in place.

        Raises:
            UnstableError: if the state is no longer finite; the message names frame and substep.
        """
        for substep in range(substeps):
            try:
                self.step(particles)
            except FloatingPointError as error:
                raise UnstableError(
                    f"{error} after substep {substep + 1} of {substeps} of frame {frame}; take more substeps, slower "
                    "particles or a softer material."
                ) from error


@jit
def _find_window(position: Array, low: Array, size: float, window: NDArray[np.int64]) -> None:
    """Write the first node of the particles along each axis, and the one after the last."""
    for axis in range(position.shape[1]):
        least = most = position[0, axis]
        for p in range(1, position.shape[0]):
            least, most = min(least, position[p, axis]), max(most, position[p, axis])
        window[0, axis], window[1, axis] = int((least - low[axis]) / size), int((most - low[axis]) / size) + 3
