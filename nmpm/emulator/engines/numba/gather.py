"""g2p: interpolation of grid values at particles, and its gradients for linear weights in 2-D.

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


ANYBODY = np.empty(0, np.int64)
"""Materials of particles that have but one."""


@jit
def gather(field: Any, material: Any, cells: Any, grid: Any, values: Any, out: Any) -> Any:
    """Fill in `out` (N, V), the interpolated values of each particle's own material, from `field` (size, M V).

    `values` is a tuple of length V, which the compiler then knows.
    """
    shape, wraps, steps = grid
    if len(steps) == 3:
        _gather_stencil(field, material, cells, grid, values, out)
        return
    many, walls = len(material) > 0, not (wraps[0] or wraps[1])
    last, layers = len(shape) - 1, shape[len(shape) - 1]
    for p in range(len(cells)):
        first = index(len(values) * material[p]) if many else index(0)
        if walls:
            i0, i1, x = linear_nodes(cells[p, 0], shape[0], False)
            j0, j1, y = linear_nodes(cells[p, 1], shape[1], False)
        else:
            i0, i1, x = linear_nodes(cells[p, 0], shape[0], wraps[0])
            j0, j1, y = linear_nodes(cells[p, 1], shape[1], wraps[1])
        a, b, c, d = i0 * shape[1] + j0, i0 * shape[1] + j1, i1 * shape[1] + j0, i1 * shape[1] + j1
        if len(shape) == 2:
            i, j, m, n = index(a), index(b), index(c), index(d)
            for k in range(len(values)):
                col = first + index(k)
                out[p, k] = bilinear(field[i, col], field[j, col], field[m, col], field[n, col], x, y)
        else:
            k0, k1, z = linear_nodes(cells[p, last], layers, wraps[last])
            a, b, c, d = a * layers, b * layers, c * layers, d * layers
            for k in range(len(values)):
                col = first + index(k)
                low = bilinear(field[a + k0, col], field[b + k0, col], field[c + k0, col], field[d + k0, col], x, y)
                high = bilinear(field[a + k1, col], field[b + k1, col], field[c + k1, col], field[d + k1, col], x, y)
                out[p, k] = (ONE - z) * low + z * high


@jit
def depths(obstacle: Any, places: Any, grid: Any, out: Any) -> Any:
    """Fill in the share of obstacle (K,) at places (K, D), interpolated linearly; `grid` has linear steps."""
    gather(obstacle.reshape(len(obstacle), 1), ANYBODY, places, grid, (0,), out.reshape(len(out), 1))


@jit
def bilinear(a: Any, b: Any, c: Any, d: Any, x: Any, y: Any) -> Any:
    """Values at (0, 0), (0, 1), (1, 0) and (1, 1), interpolated at (x, y).

    As a sum with weights, since differences would make NaN of infinite values.
    """
    return (ONE - x) * (ONE - y) * a + (ONE - x) * y * b + x * (ONE - y) * c + x * y * d


@jit
def _gather_stencil(field: Any, material: Any, cells: Any, grid: Any, values: Any, out: Any) -> Any:
    shape, wraps, steps = grid
    last, depth = len(shape) - 1, len(steps) if len(shape) == 3 else 1
    for p in range(len(cells)):
        first = len(values) * material[p] if len(material) else 0
        rows, along_x = stencil(cells[p, 0], shape[0], wraps[0], steps)
        columns, along_y = stencil(cells[p, 1], shape[1], wraps[1], steps)
        layers, along_z = stencil(cells[p, last], shape[last], wraps[last], steps)
        for k in range(len(values)):
            out[p, k] = ZERO
        for i in range(len(steps)):
            for j in range(len(steps)):
                for layer in range(depth):
                    node, weight = rows[i] * shape[1] + columns[j], np.float32(along_x[i] * along_y[j])
                    if last == 2:
                        node, weight = node * shape[last] + layers[layer], np.float32(weight * along_z[layer])
                    for k in range(len(values)):
                        out[p, k] += weight * field[node, first + k]


@jit
def gather_adjoint(
    field: Any, material: Any, mask: Any, cells: Any, grid: Any, values: Any, grad_out: Any, grad_cells: Any,
    grad_field: Any,
) -> Any:  # fmt: skip
    """Add the gradients of linear 2-D `gather` with respect to positions and field, from that of what it fills in."""
    shape, wraps, _ = grid
    for p in range(len(cells)):
        if not mask[p]:
            continue
        first = len(values) * material[p] if len(material) else 0
        i0, i1, x = linear_nodes(cells[p, 0], shape[0], wraps[0])
        j0, j1, y = linear_nodes(cells[p, 1], shape[1], wraps[1])
        a, b, c, d = i0 * shape[1] + j0, i0 * shape[1] + j1, i1 * shape[1] + j0, i1 * shape[1] + j1
        at_a, at_b, at_c, at_d = ZERO, ZERO, ZERO, ZERO
        for k in range(len(values) - 1, -1, -1):
            grad, column = grad_out[p, k], first + k
            at_a += grad * field[a, column]
            at_b += grad * field[b, column]
            at_c += grad * field[c, column]
            at_d += grad * field[d, column]
        along_x = (ONE - y) * (at_c - at_a) + y * (at_d - at_b)
        along_y = (ONE - x) * (at_b - at_a) + x * (at_d - at_c)
        grad_cells[p, 0] += weight_slope(cells[p, 0], shape[0], wraps[0]) * along_x
        grad_cells[p, 1] += weight_slope(cells[p, 1], shape[1], wraps[1]) * along_y
        for node, weight in ((a, (ONE - x) * (ONE - y)), (b, (ONE - x) * y), (c, x * (ONE - y)), (d, x * y)):
            for k in range(len(values)):
                grad_field[node, first + k] += weight * grad_out[p, k]
