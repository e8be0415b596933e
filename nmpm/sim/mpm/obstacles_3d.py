"""The kernels of obstacles in three dimensions: as in two (`obstacle_field.py`), along one more axis."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
from nmpm.sim.state import Array

if TYPE_CHECKING:
    from nmpm.sim.mpm.obstacle_field import Lattice

_PUSHES = 4


@jit
def brake(nodes: Array, fall: Array, near: NDArray[np.int64], normals: Array, friction: float) -> None:
    """As `ObstacleField.brake`, of nodes (X, Y, Z, 4)."""
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
def _look_up(point: Array, lattice: Lattice, slope: Array) -> float:
    """Distance, and the direction in which it grows, written to `slope` (3,); trilinear within the lattice."""
    low, spacing, distance, _ = lattice
    x = min(max((point[0] - low[0]) / spacing, 0.0), distance.shape[0] - 1.000001)
    y = min(max((point[1] - low[1]) / spacing, 0.0), distance.shape[1] - 1.000001)
    z = min(max((point[2] - low[2]) / spacing, 0.0), distance.shape[2] - 1.000001)
    i, j, k = int(x), int(y), int(z)
    fx, fy, fz = x - i, y - j, z - k
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
def depths(position: Array, lattice: Lattice, depth: Array) -> None:
    """As `ObstacleField.depth`, written to `depth` (N,)."""
    slope = np.empty(3)
    for p in range(position.shape[0]):
        depth[p] = max(0.0, lattice.margin - _look_up(position[p], lattice, slope))


@jit
def push_out(before: Array, position: Array, velocity: Array, lower: Array, upper: Array, lattice: Lattice) -> int:
    """As `ObstacleField.push_out`."""
    low, spacing, distances, margin = lattice
    pushed, slope, point = 0, np.empty(3), np.empty(3)
    for p in range(position.shape[0]):
        point[:] = position[p]
        # The nearest lattice point is within the margin of the particle: an early exit for most.
        i, j, k = (point[0] - low[0]) / spacing, (point[1] - low[1]) / spacing, (point[2] - low[2]) / spacing
        if distances[int(i + 0.5), int(j + 0.5), int(k + 0.5)] > 2 * margin:
            continue
        distance = _look_up(point, lattice, slope)
        if distance >= margin:
            continue
        pushed += 1
        for _ in range(_PUSHES):
            length = math.sqrt(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2)
            if length == 0:
                break
            # A little further than needed, so that rounding does not leave it inside the margin.
            step, inwards = 1.001 * (margin - distance), 0.0
            for axis in range(3):
                slope[axis] /= length
                inwards += velocity[p, axis] * slope[axis]
            for axis in range(3):
                velocity[p, axis] -= min(0.0, inwards) * slope[axis]
                point[axis] = min(max(point[axis] + step * slope[axis], lower[axis]), upper[axis])
            distance = _look_up(point, lattice, slope)
            if distance >= margin:
                break
        if distance < margin:
            point[:] = before[p]
            velocity[p] = 0.0
        position[p] = point
    return pushed
