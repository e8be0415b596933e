"""What bodies do to particles when they are dragged: push them out, and along."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from nmpm.obstacles import Body, Disc, Ramp

Movable = Ramp | Disc


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
    depth, outward = _depth_and_normal(body, position)
    out = (margin - depth).clamp(min=0).unsqueeze(-1) * outward
    touched = (depth < margin).unsqueeze(-1)
    along = (velocity * outward).sum(-1, keepdim=True)
    speed = torch.maximum(out.norm(dim=-1, keepdim=True), along)
    pushed = velocity + (speed - along) * outward
    limit = fastest.to(velocity)
    return position + out, torch.where(touched, pushed.clamp(-limit, limit), velocity)


def _depth_and_normal(body: Body, position: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) signed distances from a body's surface, and (N, D) directions away from it."""
    with torch.enable_grad():
        points = position.detach().double().requires_grad_()
        distance = body.distance(points)
        (normal,) = torch.autograd.grad(distance.sum(), points)
    return distance.detach().to(position), torch.nn.functional.normalize(normal, dim=-1).to(position)
