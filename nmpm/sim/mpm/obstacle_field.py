"""Obstacles on the grid and at the particles, from signed distances that are sampled once.

At nodes nearer to an obstacle than one cell, velocity into it is removed, and Coulomb friction brakes the velocity
along it; away from it material parts freely. The first free node is then on average one and a half cells off, as it is
at the box's sides. Slanted faces cut cells at any angle, so that this alone would let particles seep in: those that end
a substep too near are pushed out.

The particles' distance is interpolated from a lattice four times as fine as the cells (twice in three dimensions, for
its size). A distance never changes faster than its point moves, so that interpolation errs by less than half the
diagonal of a lattice cell, and a particle is kept at that margin: it is never inside. It is pushed out along the
gradient of the distance, to the side that it is on; a substep that carries it past the middle of an obstacle would let
it out behind. So the thinnest obstacle bounds the substep (`preset.py`), not the cells. Through obstacles thinner than
two cells, material on the two sides shares nodes, and each feels a little of the other's velocity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
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
        _depths(position, self.lattice, depth)
        return depth

    def brake(self, nodes: Array, fall: Array) -> None:
        """Remove momentum into the obstacles from the nodes (X, Y, 3) or (X, Y, Z, 4), in place.

        `fall` (D,) is the change of velocity by gravity that follows: its part into the obstacles is removed as well.
        """
        brake = _brake_2d if len(fall) == 2 else _brake_3d
        brake(nodes, fall, self.nodes, self.normals, self.friction)

    def push_out(self, before: Array, position: Array, velocity: Array, lower: Array, upper: Array) -> int:
        """Push particles that are too near out to the margin, and remove their velocity inwards; returns how many.

        Positions and velocities change in place. A particle that finds no room nearby, between `lower` and `upper`
        (D,), goes back to its valid position `before`, and stops.
        """
        pushed: int = _push_out(before, position, velocity, lower, upper, self.lattice)
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
def _brake_2d(nodes: Array, fall: Array, near: NDArray[np.int64], normals: Array, friction: float) -> None:
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
def _brake_3d(nodes: Array, fall: Array, near: NDArray[np.int64], normals: Array, friction: float) -> None:
    for n in range(near.shape[0]):
        node = nodes[near[n, 0], near[n, 1], near[n, 2]]
        mass, normal = node[0], normals[n]
        if mass <= 0:
            continue
        u, v, w = node[1] + mass * fall[0], node[2] + mass * fall[1], node[3] + mass * fall[2]
        inwards = u * normal[0] + v * normal[1] + w * normal[2]
        if inwards >= 0:
            continue
        u, v, w = u - inwards * normal[0], v - inwards * normal[1], w - inwards * normal[2]
        along = math.sqrt(u * u + v * v + w * w)
        left = max(0.0, along + friction * inwards) / along if along > 0 else 0.0
        node[1], node[2], node[3] = left * u - mass * fall[0], left * v - mass * fall[1], left * w - mass * fall[2]


@jit
def _look_up(point: Array, distance: Array, low: Array, spacing: float, slope: Array) -> float:
    """Distance, interpolated linearly along each axis of the lattice; the direction in which it grows to `slope`."""
    x = min(max((point[0] - low[0]) / spacing, 0.0), distance.shape[0] - 1.000001)
    y = min(max((point[1] - low[1]) / spacing, 0.0), distance.shape[1] - 1.000001)
    i, j = int(x), int(y)
    fx, fy = x - i, y - j
    if distance.ndim == 2:
        a, b, c, d = distance[i, j], distance[i + 1, j], distance[i, j + 1], distance[i + 1, j + 1]
        slope[0], slope[1] = (1 - fy) * (b - a) + fy * (d - c), (1 - fx) * (c - a) + fx * (d - b)
        return float((1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d))
    z = min(max((point[2] - low[2]) / spacing, 0.0), distance.shape[2] - 1.000001)
    k = int(z)
    fz = z - k
    value = slope[0] = slope[1] = slope[2] = 0.0
    for a in range(2):
        wx, sx = (fx, 1.0) if a else (1 - fx, -1.0)
        for b in range(2):
            wy, sy = (fy, 1.0) if b else (1 - fy, -1.0)
            for c in range(2):
                wz, sz = (fz, 1.0) if c else (1 - fz, -1.0)
                there = distance[i + a, j + b, k + c]
                value += wx * wy * wz * there
                slope[0] += sx * wy * wz * there
                slope[1] += wx * sy * wz * there
                slope[2] += wx * wy * sz * there
    return value


@jit
def _nearest(point: Array, distance: Array, low: Array, spacing: float) -> float:
    """Distance at the nearest lattice point."""
    i, j = int((point[0] - low[0]) / spacing + 0.5), int((point[1] - low[1]) / spacing + 0.5)
    if distance.ndim == 2:
        return float(distance[i, j])
    return float(distance[i, j, int((point[2] - low[2]) / spacing + 0.5)])


@jit
def _depths(position: Array, lattice: Lattice, depth: Array) -> None:
    (low, spacing, distances, margin), slope = lattice, np.empty(position.shape[1])
    for p in range(position.shape[0]):
        depth[p] = max(0.0, margin - _look_up(position[p], distances, low, spacing, slope))


@jit
def _push_out(before: Array, position: Array, velocity: Array, lower: Array, upper: Array, lattice: Lattice) -> int:
    (low, spacing, distances, margin), dim = lattice, position.shape[1]
    pushed, slope, point = 0, np.empty(dim), np.empty(dim)
    for p in range(position.shape[0]):
        # The nearest lattice point is within the margin of the particle: an early exit for most.
        if _nearest(position[p], distances, low, spacing) > 2 * margin:
            continue
        point[:] = position[p]
        distance = _look_up(point, distances, low, spacing, slope)
        if distance >= margin:
            continue
        pushed += 1
        for _ in range(_PUSHES):
            square = 0.0
            for axis in range(dim):
                square += slope[axis] * slope[axis]
            if square == 0:
                break
            # A little further than needed, so that rounding does not leave it inside the margin.
            length, step, inwards = math.sqrt(square), 1.001 * (margin - distance), 0.0
            for axis in range(dim):
                slope[axis] /= length
                inwards += velocity[p, axis] * slope[axis]
            for axis in range(dim):
                velocity[p, axis] -= min(0.0, inwards) * slope[axis]
                point[axis] = min(max(point[axis] + step * slope[axis], lower[axis]), upper[axis])
            distance = _look_up(point, distances, low, spacing, slope)
            if distance >= margin:
                break
        if distance < margin:
            point[:] = before[p]
            velocity[p] = 0.0
        position[p] = point
    return pushed
