"""Obstacles on the grid and at the particles, from signed distances that are sampled once.

At nodes nearer to an obstacle than one cell, velocity into it is removed, and Coulomb friction brakes the velocity
along it; away from it material parts freely. The first free node is then on average one and a half cells off, as it is
at the box's sides. Slanted faces cut cells at any angle, so that this alone would let particles seep in: those that end
a substep too near are pushed out.

The particles' distance is interpolated from a lattice four times as fine as the cells (twice in three dimensions, for
its size). A distance never changes faster
than its point moves, so that interpolation errs by less than half the diagonal of a lattice cell, and a particle is
kept at that margin: it is never inside. It is pushed out along the gradient of the distance, to the side that it is on;
a substep that carries it past the middle of an obstacle would let it out behind. So the thinnest obstacle bounds the
substep (`stability.py`), not the cells. Through obstacles thinner than two cells, material on the two sides shares
nodes, and each feels a little of the other's velocity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
from nmpm.sim.mpm import obstacles_3d
from nmpm.sim.state import Array

Distance = Callable[[Array], NDArray[Any]]
"""From points (K, D) to their signed distances (K,) from the obstacles, negative inside."""

_LATTICE_PER_CELL = {2: 4, 3: 2}
_PUSHES = 4


class Lattice(NamedTuple):
    """Signed distances at the points of a lattice, from the point `low` on; particles are kept at the margin."""

    low: Array
    spacing: float
    distance: Array
    margin: float


@dataclass(frozen=True)
class ObstacleField:
    """Obstacles, sampled on a grid's nodes and on a finer lattice.

    Args:
        nodes: (K, D) indices of the nodes within a cell of an obstacle.
        normals: (K, D) unit vectors out of the obstacle at these nodes.
        lattice: Of the particles' distances.
        friction: Coulomb friction of the obstacles.
    """

    nodes: NDArray[np.int64]
    normals: Array
    lattice: Lattice
    friction: float

    @classmethod
    def sample(
        cls, distance: Distance, low: Array, size: float, shape: tuple[int, ...], friction: float
    ) -> ObstacleField:
        """Sample obstacles, given by their signed distance, on cells of a size and number from the box's corner on."""
        finer = _LATTICE_PER_CELL[len(shape)]
        spacing = size / finer
        at_lattice = _sample(distance, low, spacing, [np.arange(finer * cells + 1) for cells in shape])
        at_nodes = _sample(distance, low, size, [np.arange(cells + 2) - 0.5 for cells in shape])
        near = np.argwhere(at_nodes < size)
        normals = _normals(distance, low + size * (near - 0.5), spacing / 8)
        lattice = Lattice(np.asarray(low, np.float64), spacing, at_lattice, lattice_margin(size, len(shape)))
        return cls(near, normals, lattice, friction)

    def depth(self, position: Array) -> Array:
        """(N,) how much nearer to an obstacle than the margin particles (N, D) are, in length; 0 where they are not."""
        depth = np.zeros(len(position))
        (_depths if position.shape[1] == 2 else obstacles_3d.depths)(position, self.lattice, depth)
        return depth

    def brake(self, nodes: Array, fall: Array) -> None:
        """Remove momentum into the obstacles from the nodes (X, Y, 3) or (X, Y, Z, 4), in place.

        `fall` (D,) is the change of velocity by gravity that follows: its part into the obstacles is removed as well.
        """
        brake = _brake if len(fall) == 2 else obstacles_3d.brake
        brake(nodes, fall, self.nodes, self.normals, self.friction)

    def push_out(self, before: Array, position: Array, velocity: Array, lower: Array, upper: Array) -> int:
        """Push particles that are too near out to the margin, and remove their velocity inwards; returns how many.

        Positions and velocities change in place. A particle that finds no room nearby, between `lower` and `upper`
        (D,), goes back to its valid position `before`, and stops.
        """
        push_out = _push_out if len(lower) == 2 else obstacles_3d.push_out
        pushed: int = push_out(before, position, velocity, lower, upper, self.lattice)
        return pushed


def lattice_margin(size: float, dim: int) -> float:
    """Distance from obstacles at which particles are kept on a grid with cells of that size, in length."""
    return size / _LATTICE_PER_CELL[dim] * math.sqrt(dim / 4)


def _sample(distance: Distance, low: Array, spacing: float, indices: list[NDArray[Any]]) -> Array:
    points = low + spacing * np.stack(np.meshgrid(*indices, indexing="ij"), axis=-1)
    at_points = distance(points.reshape(-1, len(indices))).reshape(points.shape[:-1])
    return np.ascontiguousarray(at_points, dtype=np.float64)


def _normals(distance: Distance, points: Array, step: float) -> Array:
    """Directions in which the distance grows, by central differences; upwards where it does not."""
    axes = np.eye(points.shape[1])
    slopes = np.stack([distance(points + step * axis) - distance(points - step * axis) for axis in axes], axis=-1)
    length = np.linalg.norm(slopes, axis=-1, keepdims=True)
    return np.where(length > 0, slopes / np.where(length > 0, length, 1.0), axes[1])


@jit
def slide(normal: float, tangential: float, friction: float) -> tuple[float, float]:
    """Velocity after contact with a wall: none into it (normal < 0), and Coulomb friction along it."""
    if normal >= 0:
        return normal, tangential
    left = max(0.0, abs(tangential) + friction * normal)
    return 0.0, left if tangential > 0 else -left


@jit
def _brake(nodes: Array, fall: Array, near: NDArray[np.int64], normals: Array, friction: float) -> None:
    for k in range(near.shape[0]):
        i, j = near[k, 0], near[k, 1]
        mass = nodes[i, j, 0]
        if mass <= 0:
            continue
        nx, ny = normals[k, 0], normals[k, 1]
        u, v = nodes[i, j, 1] + mass * fall[0], nodes[i, j, 2] + mass * fall[1]
        normal, along = slide(u * nx + v * ny, v * nx - u * ny, friction)
        nodes[i, j, 1] = normal * nx - along * ny - mass * fall[0]
        nodes[i, j, 2] = normal * ny + along * nx - mass * fall[1]


@jit
def _look_up(x: float, y: float, lattice: Lattice) -> tuple[float, float, float]:
    """Distance and the direction in which it grows, by bilinear interpolation within the lattice."""
    low, spacing, distance, _ = lattice
    px = min(max((x - low[0]) / spacing, 0.0), distance.shape[0] - 1.000001)
    py = min(max((y - low[1]) / spacing, 0.0), distance.shape[1] - 1.000001)
    i, j = int(px), int(py)
    fx, fy = px - i, py - j
    a, b, c, d = distance[i, j], distance[i + 1, j], distance[i, j + 1], distance[i + 1, j + 1]
    sx, sy = (1 - fy) * (b - a) + fy * (d - c), (1 - fx) * (c - a) + fx * (d - b)
    return (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d), sx, sy


@jit
def _depths(position: Array, lattice: Lattice, depth: Array) -> None:
    for p in range(position.shape[0]):
        depth[p] = max(0.0, lattice.margin - _look_up(position[p, 0], position[p, 1], lattice)[0])


@jit
def _push_out(before: Array, position: Array, velocity: Array, lower: Array, upper: Array, lattice: Lattice) -> int:
    low, spacing, distances, margin = lattice
    pushed = 0
    for p in range(position.shape[0]):
        x, y = position[p, 0], position[p, 1]
        # The nearest lattice point is within the margin of the particle: an early exit for most.
        near = distances[int((x - low[0]) / spacing + 0.5), int((y - low[1]) / spacing + 0.5)]
        if near > 2 * margin:
            continue
        distance, sx, sy = _look_up(x, y, lattice)
        if distance >= margin:
            continue
        pushed += 1
        for _ in range(_PUSHES):
            length = math.sqrt(sx * sx + sy * sy)
            if length == 0:
                break
            sx, sy = sx / length, sy / length
            inwards = min(0.0, velocity[p, 0] * sx + velocity[p, 1] * sy)
            velocity[p, 0] -= inwards * sx
            velocity[p, 1] -= inwards * sy
            # A little further than needed, so that rounding does not leave it inside the margin.
            step = 1.001 * (margin - distance)
            x = min(max(x + step * sx, lower[0]), upper[0])
            y = min(max(y + step * sy, lower[1]), upper[1])
            distance, sx, sy = _look_up(x, y, lattice)
            if distance >= margin:
                break
        if distance < margin:
            x, y = before[p, 0], before[p, 1]
            velocity[p, 0] = velocity[p, 1] = 0.0
        position[p, 0], position[p, 1] = x, y
    return pushed
