"""The nodes that a position touches along an axis, and their weights, as in `nmpm.transfer` and `quadratic`.

Non-finite positions are handled as each transfer does: they must not become indices.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit

HALF, ZERO, ONE = np.float32(0.5), np.float32(0), np.float32(1)
QUARTERS = np.float32(0.75)
_NO_NODE = np.int64(-(2**63))
"""What torch makes of NaN as an integer."""


@jit
def _wrap(x: Any, extent: Any) -> Any:
    """A position moved into a periodic axis; NaN if it is not finite."""
    if x >= ZERO and x < extent:
        return x
    if not np.isfinite(x):
        return np.float32(np.nan)
    inside = np.float32(x % extent)
    return inside if inside < extent else ZERO


@jit
def _interior(x: Any, count: Any, wraps: Any) -> Any:
    """A position in the domain: wrapped on a periodic axis, clamped to the faces of a wall axis."""
    extent = np.float32(count)
    if wraps:
        return _wrap(x, extent)
    if x < ZERO:
        return ZERO
    return extent if x > extent else x


@jit
def _node_below(x: Any) -> Any:
    return np.int64(np.floor(x)) if np.isfinite(x) else _NO_NODE


@jit
def _fold(node: Any, count: Any, wraps: Any) -> Any:
    """The index of a node that may lie beyond an axis' ends."""
    if node >= 0 and node < count:
        return node
    if wraps:
        return np.int64(node % count)
    return np.int64(0) if node < 0 else np.int64(count - 1)


@jit
def linear_nodes(x: Any, count: Any, wraps: Any) -> Any:
    """The two nodes around a position, and the weight of the upper one; of NaN on a wall axis: the axis' middle.

    Beyond the last centre of a wall axis the position counts as there, which folds the support onto the border node.
    """
    if wraps:
        offset = _wrap(x, np.float32(count)) - HALF
        base = _node_below(offset)
        return _fold(base, count, True), _fold(base + 1, count, True), np.float32(offset - np.floor(offset))
    last = np.float32(count - 1)
    offset = x - HALF
    if not offset > ZERO:
        offset = HALF * last if np.isnan(offset) else ZERO
    elif offset > last:
        offset = last
    lower = np.int64(offset)
    return lower, min(lower + 1, count - 1), np.float32(offset - np.float32(lower))


@jit
def scatter_nodes(x: Any, count: Any, wraps: Any) -> Any:
    """As `linear_nodes`, but a NaN is passed on to the grid, on a wall axis at its first node."""
    if np.isnan(x) and not wraps:
        return np.int64(0), np.int64(0), x
    return linear_nodes(x, count, wraps)


@jit
def stencil(x: Any, count: Any, wraps: Any, steps: Any) -> Any:
    """The nodes along an axis and their weights, three of each, unused ones with weight 0; not for linear weights."""
    inside = _interior(x, count, wraps)
    if len(steps) == 1:
        base, weights = _node_below(inside), (ONE, ZERO, ZERO)
    else:
        nearest = np.floor(inside)
        d = inside - HALF - nearest
        base = _node_below(nearest) - 1
        weights = (HALF * (HALF - d) ** 2, QUARTERS - d * d, HALF * (HALF + d) ** 2)
    nodes = (_fold(base, count, wraps), _fold(base + 1, count, wraps), _fold(base + 2, count, wraps))
    return nodes, weights


@jit
def weight_slope(x: Any, count: Any, wraps: Any) -> Any:
    """1 where the weights of `linear_nodes` change with the position, 0 where they are held at an end of the axis."""
    return ONE if wraps or (x > HALF and x < np.float32(count) - HALF) else ZERO
