"""What a call of the emulator predicts, and what stays the same between the calls of a rollout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from torch import Tensor

from nmpm.emulator.fused.views import Views
from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.fused.surroundings import Surroundings


@dataclass(frozen=True)
class Bundle:
    """The m frames that one call predicts.

    Args:
        position: (B, m, N, D) in domain length, of the precision of the positions that the emulator was given.
        velocity: (B, N, D) at the last frame, in length per frame.
        fields: (B, m, N) of each evolving field, by name, in its own unit.
    """

    position: Tensor
    velocity: Tensor
    fields: Mapping[str, Tensor] = field(default_factory=dict)

    def state_after(self, particles: Particles) -> Particles:
        """The state at the bundle's last frame, of the particles that it started from."""
        moved = particles.with_motion(self.position[:, -1], self.velocity)
        last = {name: values[:, -1] for name, values in self.fields.items()}
        return moved.with_fields(last) if last else moved


@dataclass(frozen=True)
class RolloutContext:
    """What stays the same from bundle to bundle of a rollout, computed once from its first state.

    Args:
        solid: (B, C_solid, *S) share of each cell that is wall or obstacle; C_solid is 0 or 1.
        budget: (B,) energy per mass that no frame may exceed, in grid units; None where energy is not constrained.
        surroundings: What the kernels have prepared of each scene's solids; None for nothing.
        views: What the kernels have converted to arrays; None to convert everything in each call.
    """

    solid: Tensor
    budget: Tensor | None
    surroundings: tuple[Surroundings, ...] | None = None
    views: Views | None = None

    def scenes(self, chosen: list[int]) -> RolloutContext:
        """The context of part of the batch."""
        surroundings = None if self.surroundings is None else tuple(self.surroundings[scene] for scene in chosen)
        budget = None if self.budget is None else self.budget[chosen]
        return RolloutContext(self.solid[chosen], budget, surroundings, None if self.views is None else Views())
