"""Bodies that a player moves, and what they do to particles then: push them out, and along."""

from __future__ import annotations

import dataclasses
from typing import Literal

import torch
from torch import Tensor

from nmpm.emulator import Emulator
from nmpm.obstacles import Body, Disc, Ramp

Movable = Ramp | Disc


ANGLE = -0.4
"""Of new ramps, in radians."""


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
