"""The kernels of MLS-MPM in three dimensions: as in two, along one more axis.

Where two or three walls meet, each acts in turn; friction brakes the velocity along a wall as a vector.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
from nmpm.sim.mpm.kernels_2d import Cells, Motion
from nmpm.sim.state import Array


@jit
def _weights(offset: float) -> tuple[float, float, float]:
    """Quadratic B-spline weights of three nodes; the particle is `offset` cells from the first."""
    return 0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1.0) ** 2, 0.5 * (offset - 0.5) ** 2


@jit
def scatter(
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
def _slide(normal: float, one: float, other: float, friction: float) -> tuple[float, float, float]:
    """Velocity after contact with a wall: none into it (normal < 0), and Coulomb friction along it."""
    if normal >= 0:
        return normal, one, other
    along = math.sqrt(one * one + other * other)
    left = max(0.0, along + friction * normal) / along if along > 0 else 0.0
    return 0.0, left * one, left * other


@jit
def update_nodes(
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
                    u, v, w = _slide(sign * u, v, w, friction)
                    u = 0.0 if holds else sign * u
                if at_y:
                    sign = 1.0 if 2 * j < ny else -1.0
                    v, u, w = _slide(sign * v, u, w, friction)
                    v = 0.0 if holds else sign * v
                if min(k, nz - 1 - k) <= inset + 1:
                    sign = 1.0 if 2 * k < nz else -1.0
                    w, u, v = _slide(sign * w, u, v, friction)
                    w = 0.0 if holds else sign * w
                nodes[i, j, k, 1], nodes[i, j, k, 2], nodes[i, j, k, 3] = u, v, w


@jit
def gather(nodes: Array, cells: Cells, dt: float, motion: Motion) -> int:
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
