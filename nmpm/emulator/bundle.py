"""The bundle of frames that one call predicts, and what the calls of a rollout share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.engines.numba.engine import PreparedArrays


@dataclass(frozen=True)
class Bundle:
    """The m frames that one call predicts.

    Args:
        position: (B, m, N, D) in domain length, of the precision of the positions that the emulator was given.
        velocity: (B, N, D) at the last frame, in length per frame.
        fields: (B, m, N) of each evolving field, by name, in its own unit.
        budget: (B,) energy that the rollout may have, see `Particles.budget`; None where it is not constrained.
    """

    position: Tensor
    velocity: Tensor
    fields: Mapping[str, Tensor] = field(default_factory=dict)
    budget: Tensor | None = None

    def without_absent(self, there: Tensor) -> Bundle:
        """The same with NaN for positions and fields of particles that are not `there`, (B, m, N) or (B, 1, N) bool."""
        position = torch.where(there.unsqueeze(-1), self.position, torch.nan)
        fields = {name: torch.where(there, values, torch.nan) for name, values in self.fields.items()}
        return Bundle(position, self.velocity, fields, self.budget)

    def state_after(self, particles: Particles) -> Particles:
        """The state at the bundle's last frame, of the particles that it started from.

        A rollout from there goes on as the one that led there.
        """
        moved = particles.with_motion(self.position[:, -1], self.velocity)
        last = {name: values[:, -1] for name, values in self.fields.items()}
        moved = moved.with_fields(last) if last else moved
        return moved if self.budget is None else moved.with_budget(self.budget)


@dataclass(frozen=True)
class RolloutContext:
    """The part of a call that stays the same through a rollout, computed once from its first state.

    Args:
        solid: (B, C_solid, *S) share of each cell that is wall or obstacle; C_solid is 0 or 1.
        budget: (B,) energy per mass that no frame may exceed, in grid units; None where energy is not constrained.
        prepared: What the numba engine has prepared; None to prepare it in each call.
        noise: (B, Z, *S) what a stochastic processor reads in the next call; None for zeros.
    """

    solid: Tensor
    budget: Tensor | None
    prepared: PreparedArrays | None = None
    noise: Tensor | None = None

    def scenes(self, chosen: list[int]) -> RolloutContext:
        """The context of part of the batch."""
        budget = None if self.budget is None else self.budget[chosen]
        prepared = None if self.prepared is None else self.prepared.scenes(chosen)
        return RolloutContext(self.solid[chosen], budget, prepared)
