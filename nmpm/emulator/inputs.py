"""Further input channels: what particles know beside their velocity and volume."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from torch import Tensor

from nmpm.emulator.rasterise import membership_of
from nmpm.grid import Grid
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.transfer import Nearest, Transfer
from nmpm.transfer.base import inside


@dataclass(frozen=True)
class Inputs:
    """Which further channels the processor sees.

    Args:
        acceleration: Each material's mean acceleration beside gravity at the last frame, D channels.
        moments: Number, first and second moments of the particles' places within each cell.
        shear: Momentum of each cell's particles and its first moments.
    """

    acceleration: int = 0
    moments: bool = False
    shear: bool = False
    features: int = 0

    def updates(self, frames: int) -> int:
        """Output channels per frame of the bundle that the features need."""
        return -(-self.features // frames)

    def channels(self, scene: Scene) -> tuple[str, ...]:
        """Names of the further channels, in order."""
        axes = "xyz"[: scene.dim]
        pairs = ["".join(pair) for pair in combinations_with_replacement(axes, 2)]
        names = []
        if self.acceleration:
            names += [f"{m}.acceleration_{a}" for m in scene.materials for a in axes]
        names += [f"feature_{index}" for index in range(self.features)]
        if self.moments:
            names += [f"{m}.moment{a}" for m in scene.materials for a in ["", *(f"_{a}" for a in [*axes, *pairs])]]
        if self.shear:
            names += [f"{m}.shear_{a}" for m in scene.materials for a in [*axes, *(a + b for a in axes for b in axes)]]
        return tuple(names)

    def rasterise(
        self, scene: Scene, grid: Grid, transfer: Transfer, particles: Particles, cells: Tensor, velocity: Tensor
    ) -> list[Tensor]:
        """The further channels (B, C, *S), in grid units."""
        parts: list[Tensor] = []
        if not (self.acceleration or self.moments or self.shear or self.features):
            return parts
        member = membership_of(particles, len(scene.materials))
        if self.acceleration:
            known = particles.acceleration
            values = torch.zeros_like(velocity) if known is None else grid.to_cell_displacement(known.detach(), velocity.dtype)
            weighted = (member.unsqueeze(-1) * values.unsqueeze(-2)).flatten(-2)
            sums = transfer.p2g(torch.cat([weighted, member], -1), cells.detach(), grid)
            total, count = sums.split([weighted.shape[-1], member.shape[-1]], dim=1)
            parts.append(total / torch.where(count > 0, count, 1.0).repeat_interleave(scene.dim, dim=1))
        if self.features:
            carried = particles.features
            real = particles.mask.unsqueeze(-1).to(cells.dtype)
            if carried is None:
                parts.append(cells.new_zeros(len(cells), self.features, *grid.shape))
            else:
                sums = transfer.p2g(torch.cat([carried.to(cells.dtype) * real, real], -1), cells, grid)
                parts.append(sums[:, :-1] / torch.where(sums[:, -1:] > 0, sums[:, -1:], 1.0))
        if self.moments or self.shear:
            within = inside(cells.detach(), grid)
            place = within - within.detach().floor() - 0.5
            terms = []
            if self.moments:
                pairs = combinations_with_replacement(range(scene.dim), 2)
                second = torch.stack([place[..., a] * place[..., b] for a, b in pairs], -1)
                terms += [torch.ones_like(place[..., :1]), place, second]
            if self.shear:
                terms += [velocity.detach(), (velocity.detach().unsqueeze(-1) * place.unsqueeze(-2)).flatten(-2)]
            values = torch.cat(terms, -1)
            values = (member.unsqueeze(-1) * values.unsqueeze(-2)).flatten(-2)
            parts.append(Nearest().p2g(values, cells, grid) * (scene.particle_volume / grid.cell_volume))
        return parts
