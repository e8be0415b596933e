"""Radius graphs: edges between neighbouring particles."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nmpm.errors import DataError

MOST_NEIGHBOURS = 200
"""Mean number of neighbours beyond which particles have collapsed into each other; there are 13 at rest."""


def radius_graph(position: Tensor, radius: float) -> Tensor:
    """Directed edges between particles that are at most a radius apart, both ways, without loops.

    Args:
        position: (N, D), on the CPU.
        radius: In the same length.

    Returns:
        (2, E) int64: senders and receivers.

    Raises:
        DataError: if a position is not finite, or particles have collapsed, see `MOST_NEIGHBOURS`.
    """
    if not bool(position.isfinite().all()):
        raise DataError("A particle's position is not finite, so that it has no neighbours.")
    tree = cKDTree(position.detach().double().numpy())
    if 2 * _pairs(tree, radius) > MOST_NEIGHBOURS * len(position):
        raise DataError(f"Particles have collapsed: over {MOST_NEIGHBOURS} neighbours each within {radius:g}.")
    pairs = torch.from_numpy(tree.query_pairs(radius, output_type="ndarray")).long().reshape(-1, 2)
    return torch.cat([pairs, pairs.flip(1)]).T.contiguous()


def _pairs(tree: cKDTree, radius: float) -> int:
    """Number of pairs, each counted once; needs no memory for them."""
    return int(tree.count_neighbors(tree, radius) - tree.n) // 2
