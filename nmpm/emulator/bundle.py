"""The bundle of frames that one call predicts: what it starts from, its result, and what a rollout's calls share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nmpm.emulator.fused.arrays import ArrayCache
from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.fused.solids import SolidCache


@dataclass(frozen=True)
class BundleStart:
    """The particles at the start of a bundle and the grids around them, in cells and cells per frame.

    Args:
        cells: (B, N, D) positions.
        velocity: (B, N, D) the particles' own velocities.
        gravity: (B, 1, D), what a frame adds to a velocity.
        material: (B, N) indices into the scene's materials.
        volume: (B, N) as `Particles.present_volume`.
        mask: (B, N) bool, False for padding.
        state: (B, C_in, *S), what the network has seen; velocities first, as in `output`.
        output: (B, m, C, *S), what the network predicts, C = materials * D; of its own precision.
        scale: (m, C, 1, ...), by which it is multiplied.
        solids: (B, m, *S) solid fraction at each of the frames, where obstacles move; None where they do not.
    """

    cells: Tensor
    velocity: Tensor
    gravity: Tensor
    material: Tensor
    volume: Tensor
    mask: Tensor
    state: Tensor
    output: Tensor
    scale: Tensor
    solids: Tensor | None = None

    @property
    def fields(self) -> Tensor:
        """(B, m, C, *S), the predicted velocities, of the scale's precision."""
        return self.output.to(torch.promote_types(self.scale.dtype, torch.float32)) * self.scale

    @property
    def filled(self) -> Tensor:
        """(B, 1, *S), the volume fraction of all materials that the network has seen."""
        velocities = self.output.shape[2]
        materials = velocities // self.cells.shape[-1]
        return self.state[:, velocities : velocities + materials].sum(1, keepdim=True)


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

    def without_absent(self, there: Tensor) -> Bundle:
        """The same with NaN for positions and fields of particles that are not `there`, (B, m, N) or (B, 1, N) bool."""
        position = torch.where(there.unsqueeze(-1), self.position, torch.nan)
        fields = {name: torch.where(there, values, torch.nan) for name, values in self.fields.items()}
        return Bundle(position, self.velocity, fields)

    def state_after(self, particles: Particles) -> Particles:
        """The state at the bundle's last frame, of the particles that it started from."""
        moved = particles.with_motion(self.position[:, -1], self.velocity)
        last = {name: values[:, -1] for name, values in self.fields.items()}
        return moved.with_fields(last) if last else moved


@dataclass(frozen=True)
class RolloutContext:
    """The part of a call that stays the same through a rollout, computed once from its first state.

    Args:
        solid: (B, C_solid, *S) share of each cell that is wall or obstacle; C_solid is 0 or 1.
        budget: (B,) energy per mass that no frame may exceed, in grid units; None where energy is not constrained.
        solid_caches: What kernels have prepared of each scene's solids; None to prepare it in each call.
        array_cache: Tensors that kernels have converted to arrays; None to convert them in each call.
    """

    solid: Tensor
    budget: Tensor | None
    solid_caches: tuple[SolidCache, ...] | None = None
    array_cache: ArrayCache | None = None

    def scenes(self, chosen: list[int]) -> RolloutContext:
        """The context of part of the batch."""
        budget = None if self.budget is None else self.budget[chosen]
        if self.solid_caches is None:
            return RolloutContext(self.solid[chosen], budget)
        caches = tuple(self.solid_caches[scene] for scene in chosen)
        return RolloutContext(self.solid[chosen], budget, caches, ArrayCache())
