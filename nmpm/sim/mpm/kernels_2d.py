"""The kernels of MLS-MPM in two dimensions.

Nodes have mass and momentum, (X, Y, D + 1). Only those in a window (2, D) around the particles are cleared and updated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
from nmpm.sim.mpm.obstacle_field import slide
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
def scatter(
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
def update_nodes(
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
def gather(nodes: Array, cells: Cells, dt: float, motion: Motion) -> int:
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
