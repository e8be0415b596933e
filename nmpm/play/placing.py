"""What a player puts into a scene: blocks and jets, only where there is room, and bodies, which push particles away."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nmpm.emulator import Emulator
from nmpm.obstacles import Body, Disc, Ramp
from nmpm.scene import Scene

Movable = Ramp | Disc

ANGLE = -0.4
"""Of new ramps, in radians."""
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


def new_body(kind: Literal["ramp", "disc"], centre: tuple[float, ...], emulator: Emulator) -> Movable:
    """A ramp or a disc, of a size that suits the scene and that the grid resolves."""
    cell, side = min(emulator.grid.spacing), min(high - low for low, high in emulator.scene.bounds)
    if kind == "disc":
        return Disc(centre, max(2 * cell, 0.07 * side))
    return Ramp(centre, 0.3 * side, max(1.5 * cell, 0.03 * side), ANGLE)


def moved(body: Movable, centre: tuple[float, ...], angle: float) -> Movable:
    """A body elsewhere; a disc has no angle."""
    if isinstance(body, Disc):
        return dataclasses.replace(body, centre=centre)
    return dataclasses.replace(body, centre=centre, angle=angle)


def push(body: Body, position: Tensor, velocity: Tensor, margin: float, fastest: Tensor) -> tuple[Tensor, Tensor]:
    """Positions and velocities (N, D) of particles, those within a body moved out of it, and away from it as fast.

    Args:
        body: Where it is now.
        position: In domain length.
        velocity: In length per frame.
        margin: Distance from the body's surface to which they are moved.
        fastest: (D,) largest speed away from the body, in length per frame.
    """
    touched = (body.distance(position.double()) < margin).nonzero()[:, 0]
    depth, outward = _depth_and_normal(body, position[touched])
    out = (margin - depth).clamp(min=0).unsqueeze(-1) * outward
    before, limit = velocity[touched], fastest.to(velocity)
    along = (before * outward).sum(-1, keepdim=True)
    speed = torch.maximum(out.norm(dim=-1, keepdim=True), along)
    pushed = (before + (speed - along) * outward).clamp(-limit, limit)
    return position.index_add(0, touched, out), velocity.index_copy(0, touched, pushed)


def _depth_and_normal(body: Body, position: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) signed distances from a body's surface, and (N, D) directions away from it."""
    with torch.enable_grad():
        points = position.double().requires_grad_()
        distance = body.distance(points)
        (normal,) = torch.autograd.grad(distance.sum(), points)
    return distance.detach().to(position), torch.nn.functional.normalize(normal, dim=-1).to(position)
