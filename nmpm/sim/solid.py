"""Obstacles as the grid and the particles feel them: distances sampled once, looked up in every substep.

At nodes nearer to an obstacle than one cell, velocity into it is removed, and Coulomb friction brakes what slides
along; away from it material parts freely. The first free node is then on average one and a half cells off, as it is at
the box's sides. Slanted faces cut cells as they like, so that this alone would let particles seep in: those that end a
substep too near are put back.

The particles' distance is interpolated from a lattice four times as fine as the cells. A distance never changes faster
than its place, so that interpolation errs by less than half the diagonal of a lattice cell, and a particle is held at
that distance: it is never inside. Obstacles must be at least two cells thick, or the far side's nodes and the lattice
would not tell in from out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nmpm.sim.compiled import compiled
from nmpm.sim.materials.base import Array

Distance = Callable[[Array], NDArray[Any]]
"""From points (K, 2) to their signed distances (K,) from the obstacles, negative inside."""

THINNEST = 2.0
"""Cells that an obstacle must be thick."""

_FINER = 4
_ATTEMPTS = 4


class _Cells(Protocol):
    @property
    def low(self) -> Array: ...
    @property
    def size(self) -> float: ...
    @property
    def shape(self) -> tuple[int, ...]: ...


@dataclass(frozen=True)
class Solid:
    """Obstacles, sampled on a grid's nodes and on a finer lattice.

    Args:
        nodes: (K, 2) indices of the nodes that feel an obstacle.
        normals: (K, 2) unit vectors out of the obstacle at these nodes.
        low: (2,) first point of the lattice.
        spacing: Of the lattice, in length.
        lattice: Signed distance at its points, in length.
        margin: Distance that particles keep, in length.
        friction: Coulomb friction of the obstacles.
    """

    nodes: NDArray[np.int64]
    normals: Array
    low: Array
    spacing: float
    lattice: Array
    margin: float
    friction: float

    @classmethod
    def sample(cls, grid: _Cells, distance: Distance, friction: float) -> Solid:
        """The obstacles of which `distance` tells the signed distance, in a grid's box."""
        spacing = grid.size / _FINER
        inner = [np.arange(_FINER * cells + 1) for cells in grid.shape]
        lattice = _sampled(distance, grid.low, spacing, inner)
        places = [np.arange(cells + 2) - 0.5 for cells in grid.shape]
        at_nodes = _sampled(distance, grid.low, grid.size, places)
        felt = np.argwhere(at_nodes < grid.size)
        points = grid.low + grid.size * (felt - 0.5)
        return cls(
            nodes=felt,
            normals=_normals(distance, points, spacing / 8),
            low=np.asarray(grid.low, np.float64),
            spacing=spacing,
            lattice=lattice,
            margin=spacing * math.sqrt(0.5),
            friction=friction,
        )

    def depth(self, position: Array) -> Array:
        """(N,) how much nearer to an obstacle than the margin particles (N, 2) are, in length; 0 where they are not."""
        depth = np.zeros(len(position))
        _depths(position, self.low, self.spacing, self.lattice, self.margin, depth)
        return depth

    def brake(self, nodes: Array, fall: Array) -> None:
        """Take what goes into the obstacles from the nodes (X, Y, 3), which hold mass and momentum.

        Args:
            nodes: Changed in place.
            fall: (2,) change of velocity that they are about to undergo, which is braked as well.
        """
        _brake(nodes, fall, self.nodes, self.normals, self.friction)

    def push_out(self, before: Array, position: Array, velocity: Array, lower: Array, upper: Array) -> int:
        """Put particles that are too near back to the margin, without their velocity inwards; returns how many.

        Args:
            before: (N, 2) where they were when all was well; one that finds no room nearby goes there, and stops.
            position: (N, 2), changed in place.
            velocity: (N, 2), changed in place.
            lower: (2,) least position.
            upper: (2,) largest position.
        """
        pushed: int = _push_out(
            before, position, velocity, lower, upper, self.low, self.spacing, self.lattice, self.margin
        )
        return pushed


def _sampled(distance: Distance, low: Array, spacing: float, places: list[NDArray[Any]]) -> Array:
    points = low + spacing * np.stack(np.meshgrid(*places, indexing="ij"), axis=-1)
    return np.ascontiguousarray(distance(points.reshape(-1, 2)).reshape(points.shape[:2]), dtype=np.float64)


def _normals(distance: Distance, points: Array, step: float) -> Array:
    """Directions in which the distance grows, by central differences; upwards where it does not."""
    slopes = np.stack([distance(points + step * axis) - distance(points - step * axis) for axis in np.eye(2)], axis=-1)
    length = np.linalg.norm(slopes, axis=-1, keepdims=True)
    return np.where(length > 0, slopes / np.where(length > 0, length, 1.0), np.array([0.0, 1.0]))


@compiled
def slide(normal: float, tangential: float, friction: float) -> tuple[float, float]:
    """Velocity at a wall, which takes what goes into it (normal < 0) and brakes what slides along."""
    if normal >= 0:
        return normal, tangential
    left = max(0.0, abs(tangential) + friction * normal)
    return 0.0, left if tangential > 0 else -left


@compiled
def _brake(nodes: Array, fall: Array, felt: NDArray[np.int64], normals: Array, friction: float) -> None:
    for k in range(felt.shape[0]):
        i, j = felt[k, 0], felt[k, 1]
        mass = nodes[i, j, 0]
        if mass <= 0:
            continue
        nx, ny = normals[k, 0], normals[k, 1]
        u, v = nodes[i, j, 1] + mass * fall[0], nodes[i, j, 2] + mass * fall[1]
        normal, along = slide(u * nx + v * ny, v * nx - u * ny, friction)
        nodes[i, j, 1] = normal * nx - along * ny - mass * fall[0]
        nodes[i, j, 2] = normal * ny + along * nx - mass * fall[1]


@compiled
def _look_up(x: float, y: float, low: Array, spacing: float, lattice: Array) -> tuple[float, float, float]:
    """Distance and the direction in which it grows, by bilinear interpolation within the lattice."""
    px = min(max((x - low[0]) / spacing, 0.0), lattice.shape[0] - 1.000001)
    py = min(max((y - low[1]) / spacing, 0.0), lattice.shape[1] - 1.000001)
    i, j = int(px), int(py)
    fx, fy = px - i, py - j
    a, b, c, d = lattice[i, j], lattice[i + 1, j], lattice[i, j + 1], lattice[i + 1, j + 1]
    sx, sy = (1 - fy) * (b - a) + fy * (d - c), (1 - fx) * (c - a) + fx * (d - b)
    return (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d), sx, sy


@compiled
def _depths(position: Array, low: Array, spacing: float, lattice: Array, margin: float, depth: Array) -> None:
    for p in range(position.shape[0]):
        depth[p] = max(0.0, margin - _look_up(position[p, 0], position[p, 1], low, spacing, lattice)[0])


@compiled
def _push_out(
    before: Array,
    position: Array,
    velocity: Array,
    lower: Array,
    upper: Array,
    low: Array,
    spacing: float,
    lattice: Array,
    margin: float,
) -> int:
    pushed = 0
    for p in range(position.shape[0]):
        x, y = position[p, 0], position[p, 1]
        # The nearest lattice point is within the margin of the particle: most are far, and that is all they cost.
        near = lattice[int((x - low[0]) / spacing + 0.5), int((y - low[1]) / spacing + 0.5)]
        if near > 2 * margin:
            continue
        distance, sx, sy = _look_up(x, y, low, spacing, lattice)
        if distance >= margin:
            continue
        pushed += 1
        for _ in range(_ATTEMPTS):
            length = math.sqrt(sx * sx + sy * sy)
            if length == 0:
                break
            sx, sy = sx / length, sy / length
            inwards = min(0.0, velocity[p, 0] * sx + velocity[p, 1] * sy)
            velocity[p, 0] -= inwards * sx
            velocity[p, 1] -= inwards * sy
            # A little further than needed, as rounding must not leave it a hair too near.
            step = 1.001 * (margin - distance)
            x = min(max(x + step * sx, lower[0]), upper[0])
            y = min(max(y + step * sy, lower[1]), upper[1])
            distance, sx, sy = _look_up(x, y, low, spacing, lattice)
            if distance >= margin:
                break
        if distance < margin:
            x, y = before[p, 0], before[p, 1]
            velocity[p, 0] = velocity[p, 1] = 0.0
        position[p, 0], position[p, 1] = x, y
    return pushed
