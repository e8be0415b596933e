"""Where new particles go: blocks on a lattice, jets row by row, and both only where there is room."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nmpm.obstacles import Body
from nmpm.scene import Scene

_CLEARANCE = 0.75
"""Least distance of a new particle from others, in spacings."""
_ROWS = 2
"""Of particles that are poured at once: each time costs a call."""
_SLOWEST = 0.5
"""A slow jet flows as if by this share of a particle's spacing in a frame."""


def block(at: Sequence[float], sides: Sequence[float], spacing: float) -> Tensor:
    """(N, D) points of a lattice that fills a box about a point."""
    counts = [max(1, round(side / spacing)) for side in sides]
    axes = [torch.arange(n, dtype=torch.float64) - (n - 1) / 2 for n in counts]
    lattice = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(counts))
    return torch.tensor(at, dtype=torch.float64) + spacing * lattice


def row(at: Sequence[float], direction: Sequence[float], width: float, spacing: float) -> Tensor:
    """(N, 2) points side by side about a point, across a direction; in three dimensions (N, 3), a square of them."""
    along = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    steps = torch.arange(max(1, round(width / spacing)), dtype=torch.float64)
    offsets = spacing * (steps - (len(steps) - 1) / 2)
    axes: Tensor = torch.linalg.svd(along[None])[2][1:]
    grids = torch.meshgrid(*[offsets] * len(axes), indexing="ij")
    across = torch.stack([grid.reshape(-1) for grid in grids], dim=-1)
    return torch.tensor(at, dtype=torch.float64) + across @ axes


def with_room(points: Tensor, scene: Scene, others: Iterable[Tensor], bodies: Iterable[Body]) -> Tensor:
    """Those of points (N, D) that are within the bounds, apart from others (M, D), and outside of bodies."""
    clearance = _CLEARANCE * scene.particle_spacing
    low, high = points.new_tensor(scene.bounds).T
    free = ((points >= low) & (points <= high)).all(-1)
    for body in bodies:
        free &= body.distance(points) > clearance / 2
    for positions in others:
        finite = positions[positions.isfinite().all(-1)].numpy()
        if len(finite):
            apart, _ = cKDTree(finite).query(points.numpy(), distance_upper_bound=clearance)
            free &= torch.from_numpy(np.isinf(apart))
    return points[free]


class Pour(NamedTuple):
    """A material that is poured at a point (D,) with a velocity (D,), in domain length and seconds."""

    material: int
    at: Sequence[float]
    velocity: Sequence[float]
    width: float


class Jet:
    """Rows of particles, one behind the other, as fast as what is poured now, `pour`, flows; None for nothing.

    Args:
        spacing: Between particles, in domain length.
        dt: Time between frames, in seconds.
    """

    def __init__(self, spacing: float, dt: float) -> None:
        self._spacing, self._dt, self._flown = spacing, dt, 0.0
        self.pour: Pour | None = None

    def turn(self, pour: Pour | None) -> None:
        """Pour, elsewhere, or no longer; the first rows come at once."""
        if pour is None or self.pour is None:
            self._flown = math.inf
        self.pour = pour

    def rows(self, pour: Pour) -> Tensor | None:
        """(N, D) particles for the next frame; None until the last ones have made room."""
        speed = math.hypot(*pour.velocity)
        self._flown += max(speed * self._dt, _SLOWEST * self._spacing)
        if self._flown < _ROWS * self._spacing:
            return None
        self._flown = 0.0
        steps = [number * self._spacing / speed for number in range(_ROWS)]
        centres = [[x + step * v for x, v in zip(pour.at, pour.velocity, strict=True)] for step in steps]
        return torch.cat([row(centre, pour.velocity, pour.width, self._spacing) for centre in centres])
