"""g2p: interpolation of velocities at particles, and its gradients for linear weights in 2-D.

A block of particles is taken frame by frame, not a particle through its frames: particles of a block do not depend on
each other, so the processor computes several at once, three times as fast.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm.emulator.engines.numba.nodes import ONE, ZERO, linear_nodes, stencil, weight_slope

index = np.uint64
"""Of what is not negative: Numba checks signed indices for counting from the end, which costs a quarter of the time."""


@jit
def gather(field: Any, material: Any, cells: Any, shape: Any, wraps: Any, steps: Any, out: Any) -> Any:
    """Fill in `out` (N, D), the interpolated velocity of each particle's own material; linear or quadratic."""
    if len(steps) == 3:
        _gather_stencil(field, material, cells, shape, wraps, steps, out)
    elif len(shape) == 2:
        _gather_linear_2d(field, material, cells, shape, wraps, out)
    else:
        _gather_linear_3d(field, material, cells, shape, wraps, out)


@jit
def _gather_linear_2d(field: Any, material: Any, cells: Any, shape: Any, wraps: Any, out: Any) -> Any:
    many, walls = len(material) > 0, not (wraps[0] or wraps[1])
    for p in range(len(cells)):
        first = index(2 * material[p]) if many else index(0)
        if walls:
            i0, i1, x = linear_nodes(cells[p, 0], shape[0], False)
            j0, j1, y = linear_nodes(cells[p, 1], shape[1], False)
        else:
            i0, i1, x = linear_nodes(cells[p, 0], shape[0], wraps[0])
            j0, j1, y = linear_nodes(cells[p, 1], shape[1], wraps[1])
        a, b = index(i0 * shape[1] + j0), index(i0 * shape[1] + j1)
        c, d = index(i1 * shape[1] + j0), index(i1 * shape[1] + j1)
        for k in range(2):
            col = first + index(k)
            out[p, k] = bilinear(field[a, col], field[b, col], field[c, col], field[d, col], x, y)


@jit
def bilinear(a: Any, b: Any, c: Any, d: Any, x: Any, y: Any) -> Any:
    """Values at (0, 0), (0, 1), (1, 0) and (1, 1), interpolated at (x, y).

    As a sum with weights, since differences would make NaN of infinite values.
    """
    return (ONE - x) * (ONE - y) * a + (ONE - x) * y * b + x * (ONE - y) * c + x * y * d


@jit
def _gather_linear_3d(field: Any, material: Any, cells: Any, shape: Any, wraps: Any, out: Any) -> Any:
    for p in range(len(cells)):
        first = 3 * material[p] if len(material) else 0
        i0, i1, x = linear_nodes(cells[p, 0], shape[0], wraps[0])
        j0, j1, y = linear_nodes(cells[p, 1], shape[1], wraps[1])
        k0, k1, z = linear_nodes(cells[p, 2], shape[2], wraps[2])
        a, b = (i0 * shape[1] + j0) * shape[2], (i0 * shape[1] + j1) * shape[2]
        c, d = (i1 * shape[1] + j0) * shape[2], (i1 * shape[1] + j1) * shape[2]
        for k in range(first, first + 3):
            low = bilinear(field[a + k0, k], field[b + k0, k], field[c + k0, k], field[d + k0, k], x, y)
            high = bilinear(field[a + k1, k], field[b + k1, k], field[c + k1, k], field[d + k1, k], x, y)
            out[p, k - first] = (ONE - z) * low + z * high


@jit
def _gather_stencil(field: Any, material: Any, cells: Any, shape: Any, wraps: Any, steps: Any, out: Any) -> Any:
    dim = len(shape)
    last, depth = dim - 1, len(steps) if dim == 3 else 1
    for p in range(len(cells)):
        first = dim * material[p] if len(material) else 0
        rows, along_x = stencil(cells[p, 0], shape[0], wraps[0], steps)
        columns, along_y = stencil(cells[p, 1], shape[1], wraps[1], steps)
        layers, along_z = stencil(cells[p, last], shape[last], wraps[last], steps)
        for k in range(dim):
            out[p, k] = ZERO
        for i in range(len(steps)):
            for j in range(len(steps)):
                for layer in range(depth):
                    node, weight = rows[i] * shape[1] + columns[j], np.float32(along_x[i] * along_y[j])
                    if dim == 3:
                        node, weight = node * shape[last] + layers[layer], np.float32(weight * along_z[layer])
                    for k in range(dim):
                        out[p, k] += weight * field[node, first + k]


@jit
def gather_adjoint(
    field: Any, material: Any, mask: Any, cells: Any, shape: Any, wraps: Any, grad_out: Any, grad_cells: Any,
    grad_field: Any,
) -> Any:  # fmt: skip
    """Add the gradients of linear 2-D `gather` with respect to positions and field, from that of what it fills in."""
    many, walls = len(material) > 0, not (wraps[0] or wraps[1])
    for p in range(len(cells)):
        if not mask[p]:
            continue
        col = 2 * material[p] if many else 0
        if walls:
            i0, i1, x = linear_nodes(cells[p, 0], shape[0], False)
            j0, j1, y = linear_nodes(cells[p, 1], shape[1], False)
        else:
            i0, i1, x = linear_nodes(cells[p, 0], shape[0], wraps[0])
            j0, j1, y = linear_nodes(cells[p, 1], shape[1], wraps[1])
        a, b, c, d = i0 * shape[1] + j0, i0 * shape[1] + j1, i1 * shape[1] + j0, i1 * shape[1] + j1
        u, v = grad_out[p, 0], grad_out[p, 1]
        at_a = u * field[a, col] + v * field[a, col + 1]
        at_b = u * field[b, col] + v * field[b, col + 1]
        at_c = u * field[c, col] + v * field[c, col + 1]
        at_d = u * field[d, col] + v * field[d, col + 1]
        along_x = (ONE - y) * (at_c - at_a) + y * (at_d - at_b)
        along_y = (ONE - x) * (at_b - at_a) + x * (at_d - at_c)
        grad_cells[p, 0] += weight_slope(cells[p, 0], shape[0], wraps[0]) * along_x
        grad_cells[p, 1] += weight_slope(cells[p, 1], shape[1], wraps[1]) * along_y
        for node, weight in ((a, (ONE - x) * (ONE - y)), (b, (ONE - x) * y), (c, x * (ONE - y)), (d, x * y)):
            grad_field[node, col] += weight * u
            grad_field[node, col + 1] += weight * v
