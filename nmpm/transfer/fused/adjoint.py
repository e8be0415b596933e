"""The adjoints of `gather` and `scatter` with linear weights in 2-D: how a number that depends on their results changes
with positions and values. Gradients of a loss, for trainings on a CPU.

A particle's interpolated value changes with its position as the nodes around it differ; beyond the last centres of a
wall axis, where all weight is the border node's, it does not.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm.transfer.fused.nodes import HALF, ONE, ZERO, linear_nodes


@jit
def _follows(x: Any, count: Any, wraps: Any) -> Any:
    """1 where the weights of `linear_nodes` change with the position, 0 where they are held at an end of the axis."""
    return ONE if wraps or (x > HALF and x < np.float32(count) - HALF) else ZERO


@jit
def gather_adjoint(
    field: Any, material: Any, mask: Any, cells: Any, shape: Any, wraps: Any, slope: Any, place: Any, nodes: Any
) -> Any:
    """Add what a gradient with respect to `gather`'s result means for positions and field.

    Args:
        field: (size, C) with the velocities of all materials first, D columns each.
        material: (N,) int64; empty where there is only one.
        mask: (N,) bool, False for padding, which gets and gives no gradient.
        cells: (N, D) positions.
        shape: Nodes along each axis, a tuple.
        wraps: Whether each is periodic, a tuple.
        slope: (N, D) gradient with respect to the interpolated velocities.
        place: (N, D) gradient with respect to the positions, is added to.
        nodes: (size, C) gradient with respect to the field, is added to.
    """
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
        u, v = slope[p, 0], slope[p, 1]
        at_a = u * field[a, col] + v * field[a, col + 1]
        at_b = u * field[b, col] + v * field[b, col + 1]
        at_c = u * field[c, col] + v * field[c, col + 1]
        at_d = u * field[d, col] + v * field[d, col + 1]
        along_x = (ONE - y) * (at_c - at_a) + y * (at_d - at_b)
        along_y = (ONE - x) * (at_b - at_a) + x * (at_d - at_c)
        place[p, 0] += _follows(cells[p, 0], shape[0], wraps[0]) * along_x
        place[p, 1] += _follows(cells[p, 1], shape[1], wraps[1]) * along_y
        for node, weight in ((a, (ONE - x) * (ONE - y)), (b, (ONE - x) * y), (c, x * (ONE - y)), (d, x * y)):
            nodes[node, col] += weight * u
            nodes[node, col + 1] += weight * v


@jit
def scatter_adjoint(
    values: Any, material: Any, mask: Any, cells: Any, shape: Any, wraps: Any, mean: Any, slope: Any, place: Any,
    speed: Any,
) -> Any:  # fmt: skip
    """Add what gradients with respect to means and numbers on the nodes mean for positions and values.

    Args:
        values: (N, V), e.g. velocities; V may be 0.
        material: (N,) int64; empty where there is only one. Particles of an unknown one count nowhere.
        mask: (N,) bool, False for padding, which gets no gradient.
        cells: (N, D) positions.
        shape: Nodes along each axis, a tuple.
        wraps: Whether each is periodic, a tuple.
        mean: (size, M V + ...), first the means of each material's values: their sums over the numbers.
        slope: (size, M V + M): gradients with respect to the sums at fixed means of each material, then to its numbers
            at fixed means.
        place: (N, D) gradient with respect to the positions, is added to.
        speed: (N, V) gradient with respect to the values, is added to.
    """
    materials = slope.shape[1] // (values.shape[1] + 1)
    for p in range(len(cells)):
        own = material[p] if len(material) else 0
        if not mask[p] or own < 0 or own >= materials:
            continue
        i0, i1, x = linear_nodes(cells[p, 0], shape[0], wraps[0])
        j0, j1, y = linear_nodes(cells[p, 1], shape[1], wraps[1])
        along_x, along_y = ZERO, ZERO
        for row, at_x, up_x in ((i0, ONE - x, -ONE), (i1, x, ONE)):
            for column, at_y, up_y in ((j0, ONE - y, -ONE), (j1, y, ONE)):
                node = row * shape[1] + column
                seen = _add_corner(values, p, own, materials, mean, slope, node, at_x * at_y, speed)
                along_x += up_x * at_y * seen
                along_y += at_x * up_y * seen
        place[p, 0] += _follows(cells[p, 0], shape[0], wraps[0]) * along_x
        place[p, 1] += _follows(cells[p, 1], shape[1], wraps[1]) * along_y


@jit
def _add_corner(
    values: Any, p: Any, own: Any, materials: Any, mean: Any, slope: Any, node: Any, weight: Any, speed: Any
) -> Any:
    """Add a node's share to a particle's `speed`; return the gradient with respect to the particle's weight there.

    A mean changes with a weight by (value - mean) / number: taken apart, two large numbers would cancel each other
    where the number is small.
    """
    width = values.shape[1]
    seen = slope[node, materials * width + own]
    for k in range(width):
        col = own * width + k
        speed[p, k] += weight * slope[node, col]
        seen += slope[node, col] * (values[p, k] - mean[node, col])
    return seen
