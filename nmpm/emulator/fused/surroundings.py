"""What the kernels know of a scene's solids: made once for a rollout, as nothing in it changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.fused.contact import fill_clearance, fill_share
from nmpm.emulator.fused.crowding import conductances
from nmpm.emulator.fused.plan import Array, Plan

_NONE = np.empty(0, np.float32)


@dataclass(frozen=True)
class Room:
    """What overfull cells spread into; arguments of `crowding.push`.

    Args:
        room: (size,).
        faces: (D, size).
        inverse: (size,).
    """

    room: Array
    faces: Array
    inverse: Array


@dataclass(frozen=True)
class Surroundings:
    """The solids of one scene.

    Args:
        share: (size,) of each cell's room that is obstacle; empty where there can be no obstacles.
        clearance: (size,) cells, from `contact.fill_clearance`; empty where it is not known.
        room: Where crowding is limited.
    """

    share: Array
    clearance: Array
    room: Room | None


def survey(plan: Plan, solid: Tensor, walls: Tensor) -> tuple[Surroundings, ...]:
    """The surroundings of each scene, for one call.

    Args:
        plan: Of the emulator.
        solid: (B, C_solid, *S) share of each cell that is wall or obstacle.
        walls: (*S), of which wall.
    """
    return tuple(_survey_scene(plan, own, walls) for own in solid)


def survey_rollout(plan: Plan, solid: Tensor, walls: Tensor) -> tuple[Surroundings, ...]:
    """As `survey`, for many calls: with clearances, which take longer to make than they save in one."""
    found = survey(plan, solid, walls)
    return tuple(Surroundings(own.share, _clearance(plan, own.share), own.room) for own in found)


def _survey_scene(plan: Plan, solid: Tensor, walls: Tensor) -> Surroundings:
    own, rooms = _flat(solid), _flat(walls)
    share = np.empty(len(own) if plan.obstacles else 0, np.float32)
    if plan.obstacles:
        fill_share(own, rooms, share)
    return Surroundings(share, _NONE, _find_room(plan, 1 - (own if len(own) else rooms)) if plan.density_cap else None)


def _find_room(plan: Plan, room: Array) -> Room:
    faces, inverse = np.empty((plan.dim, len(room)), np.float32), np.empty_like(room)
    conductances(room, plan.shape, plan.wraps, plan.ratio, faces, inverse)
    return Room(room, faces, inverse)


def _clearance(plan: Plan, share: Array) -> Array:
    clearance = np.empty_like(share)
    if len(share):
        fill_clearance(share, (plan.shape, plan.wraps), clearance)
    return clearance


def _flat(tensor: Tensor) -> Array:
    return np.asarray(tensor.detach().to(torch.float32).contiguous().numpy()).reshape(-1)
