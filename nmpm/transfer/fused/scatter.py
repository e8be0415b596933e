"""p2g: sums of particles' values and of their number over the nodes, each material apart, in one pass."""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm.transfer.fused.nodes import ONE, linear_nodes, stencil


@jit
def scatter(values: Any, material: Any, mask: Any, cells: Any, shape: Any, wraps: Any, steps: Any, out: Any) -> Any:
    """Add to each node its share of the particles.

    Args:
        values: (N, V), e.g. velocities.
        material: (N,) int64; empty where there is only one. Particles of an unknown one count nowhere.
        mask: (N,) bool, False for padding, which is left out.
        cells: (N, D) positions.
        shape: Nodes along each axis, a tuple.
        wraps: Whether each is periodic, a tuple.
        steps: As many integers as the kernel has nodes along an axis: 1 (nearest), 2 (linear) or 3 (quadratic).
        out: (size, M V + M), is added to: the values of each material, then the number of particles of each.
    """
    if len(steps) != 2:
        _scatter_stencil(values, material, mask, cells, shape, wraps, steps, out)
    elif len(shape) == 2:
        _scatter_linear_2d(values, material, mask, cells, shape, wraps, out)
    else:
        _scatter_linear_3d(values, material, mask, cells, shape, wraps, out)


@jit
def _scatter_linear_2d(values: Any, material: Any, mask: Any, cells: Any, shape: Any, wraps: Any, out: Any) -> Any:
    width = values.shape[1]
    materials = out.shape[1] // (width + 1)
    for p in range(len(cells)):
        own = material[p] if len(material) else 0
        if not mask[p] or own < 0 or own >= materials:
            continue
        i0, i1, x = _linear_nodes(cells[p, 0], shape[0], wraps[0])
        j0, j1, y = _linear_nodes(cells[p, 1], shape[1], wraps[1])
        a, b, c, d = i0 * shape[1] + j0, i0 * shape[1] + j1, i1 * shape[1] + j0, i1 * shape[1] + j1
        at_a, at_b, at_c, at_d = (ONE - x) * (ONE - y), (ONE - x) * y, x * (ONE - y), x * y
        for k in range(width + 1):
            value = values[p, k] if k < width else ONE
            place = own * width + k if k < width else materials * width + own
            out[a, place] += at_a * value
            out[b, place] += at_b * value
            out[c, place] += at_c * value
            out[d, place] += at_d * value


@jit
def _scatter_linear_3d(values: Any, material: Any, mask: Any, cells: Any, shape: Any, wraps: Any, out: Any) -> Any:
    width = values.shape[1]
    materials = out.shape[1] // (width + 1)
    for p in range(len(cells)):
        own = material[p] if len(material) else 0
        if not mask[p] or own < 0 or own >= materials:
            continue
        i0, i1, x = _linear_nodes(cells[p, 0], shape[0], wraps[0])
        j0, j1, y = _linear_nodes(cells[p, 1], shape[1], wraps[1])
        k0, k1, z = _linear_nodes(cells[p, 2], shape[2], wraps[2])
        for row, along_x in ((i0, ONE - x), (i1, x)):
            for column, along_y in ((j0, ONE - y), (j1, y)):
                node, weight = (row * shape[1] + column) * shape[2], along_x * along_y
                for k in range(width + 1):
                    value = values[p, k] if k < width else ONE
                    place = own * width + k if k < width else materials * width + own
                    out[node + k0, place] += weight * (ONE - z) * value
                    out[node + k1, place] += weight * z * value


@jit
def _linear_nodes(x: Any, count: Any, wraps: Any) -> Any:
    """As `linear_nodes`, but a NaN is passed on to the grid, on a wall axis at its first node."""
    lower, upper, share = linear_nodes(x, count, wraps)
    if not np.isnan(x):
        return lower, upper, share
    return (lower, upper, np.float32(np.nan)) if wraps else (np.int64(0), np.int64(0), np.float32(np.nan))


@jit
def _scatter_stencil(
    values: Any, material: Any, mask: Any, cells: Any, shape: Any, wraps: Any, steps: Any, out: Any
) -> Any:
    width, last, depth = values.shape[1], len(shape) - 1, len(steps) if len(shape) == 3 else 1
    materials = out.shape[1] // (width + 1)
    for p in range(len(cells)):
        own = material[p] if len(material) else 0
        if not mask[p] or own < 0 or own >= materials:
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
                        out[node, own * width + k] += weight * values[p, k]
                    out[node, materials * width + own] += weight
