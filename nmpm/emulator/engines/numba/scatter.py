"""p2g: sums of particles' values and of their number over the nodes, each material apart; gradients for linear 2-D."""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm.emulator.engines.numba.nodes import ONE, ZERO, linear_nodes, scatter_nodes, stencil, weight_slope


@jit
def scatter(values: Any, material: Any, mask: Any, cells: Any, grid: Any, out: Any) -> Any:
    """Add to `out` (size, M V + M) the values (N, V) of the particles of each material, then their numbers.

    V may be 0. Particles of an unknown material count nowhere.
    """
    if len(grid[2]) == 2:
        _scatter_linear(values, material, mask, cells, grid, out)
    else:
        _scatter_stencil(values, material, mask, cells, grid, out)


@jit
def _scatter_linear(values: Any, material: Any, mask: Any, cells: Any, grid: Any, out: Any) -> Any:
    shape, wraps, _ = grid
    width, last, layers = values.shape[1], len(shape) - 1, shape[len(shape) - 1]
    materials = out.shape[1] // (width + 1)
    for p in range(len(cells)):
        kind = material[p] if len(material) else 0
        if not mask[p] or kind < 0 or kind >= materials:
            continue
        i0, i1, x = scatter_nodes(cells[p, 0], shape[0], wraps[0])
        j0, j1, y = scatter_nodes(cells[p, 1], shape[1], wraps[1])
        a, b, c, d = i0 * shape[1] + j0, i0 * shape[1] + j1, i1 * shape[1] + j0, i1 * shape[1] + j1
        at_a, at_b, at_c, at_d = (ONE - x) * (ONE - y), (ONE - x) * y, x * (ONE - y), x * y
        k0, k1, z = scatter_nodes(cells[p, last], layers, wraps[last]) if last == 2 else (j0, j1, y)
        for k in range(width + 1):
            value = values[p, k] if k < width else ONE
            column = kind * width + k if k < width else materials * width + kind
            if last == 1:
                out[a, column] += at_a * value
                out[b, column] += at_b * value
                out[c, column] += at_c * value
                out[d, column] += at_d * value
            else:
                for node, weight in ((a, at_a), (b, at_b), (c, at_c), (d, at_d)):
                    out[node * layers + k0, column] += weight * (ONE - z) * value
                    out[node * layers + k1, column] += weight * z * value


@jit
def _scatter_stencil(values: Any, material: Any, mask: Any, cells: Any, grid: Any, out: Any) -> Any:
    shape, wraps, steps = grid
    width, last, depth = values.shape[1], len(shape) - 1, len(steps) if len(shape) == 3 else 1
    materials = out.shape[1] // (width + 1)
    for p in range(len(cells)):
        kind = material[p] if len(material) else 0
        if not mask[p] or kind < 0 or kind >= materials:
            continue
        rows, along_x = stencil(cells[p, 0], shape[0], wraps[0], steps)
        columns, along_y = stencil(cells[p, 1], shape[1], wraps[1], steps)
        layers, along_z = stencil(cells[p, last], shape[last], wraps[last], steps)
        for i in range(len(steps)):
            for j in range(len(steps)):
                for layer in range(depth):
                    node, weight = rows[i] * shape[1] + columns[j], np.float32(along_x[i] * along_y[j])
                    if last == 2:
                        node, weight = node * shape[last] + layers[layer], np.float32(weight * along_z[layer])
                    for k in range(width):
                        out[node, kind * width + k] += weight * values[p, k]
                    out[node, materials * width + kind] += weight


@jit
def scatter_adjoint(
    values: Any, material: Any, mask: Any, cells: Any, grid: Any, mean: Any, grad_out: Any, grad_cells: Any,
    grad_values: Any,
) -> Any:  # fmt: skip
    """Add the gradients of linear 2-D `scatter` with respect to positions and values.

    `mean` (size, M V + ...) begins with the means of each material's values: their sums over the numbers. `grad_out`
    (size, M V + M) has the gradients with respect to the sums, then to the numbers, each at fixed means.
    """
    shape, wraps, _ = grid
    materials = grad_out.shape[1] // (values.shape[1] + 1)
    for p in range(len(cells)):
        kind = material[p] if len(material) else 0
        if not mask[p] or kind < 0 or kind >= materials:
            continue
        i0, i1, x = linear_nodes(cells[p, 0], shape[0], wraps[0])
        j0, j1, y = linear_nodes(cells[p, 1], shape[1], wraps[1])
        along_x, along_y = ZERO, ZERO
        for row, at_x, up_x in ((i0, ONE - x, -ONE), (i1, x, ONE)):
            for column, at_y, up_y in ((j0, ONE - y, -ONE), (j1, y, ONE)):
                node = row * shape[1] + column
                slope = _add_corner(values, p, kind, materials, mean, grad_out, node, at_x * at_y, grad_values)
                along_x += up_x * at_y * slope
                along_y += at_x * up_y * slope
        grad_cells[p, 0] += weight_slope(cells[p, 0], shape[0], wraps[0]) * along_x
        grad_cells[p, 1] += weight_slope(cells[p, 1], shape[1], wraps[1]) * along_y


@jit
def _add_corner(
    values: Any, p: Any, kind: Any, materials: Any, mean: Any, grad_out: Any, node: Any, weight: Any, grad_values: Any
) -> Any:
    """Add a node's share to a particle's gradient; return the gradient with respect to the particle's weight there.

    A mean changes with a weight by (value - mean) / number: taken apart, two large numbers would cancel each other
    where the number is small.
    """
    width = values.shape[1]
    slope = grad_out[node, materials * width + kind]
    for k in range(width):
        col = kind * width + k
        grad_values[p, k] += weight * grad_out[node, col]
        slope += grad_out[node, col] * (values[p, k] - mean[node, col])
    return slope
