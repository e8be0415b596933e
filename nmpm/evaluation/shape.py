"""The shape of settled material: how high it stands, how many cells it occupies and how crowded these are.

Position errors barely notice a liquid that slowly loses its volume; these measures do.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from nmpm.grid import Grid
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.transfer import Nearest

MOST_CROWDED = 0.05
"""Share of the occupied cells that `Shape.peak_crowding` averages: the most crowded ones."""


@dataclass(frozen=True)
class Shape:
    """Measures of B scenes at one frame.

    Args:
        height: (B,) mean height of the particles above the lowest bound, against gravity, in domain length.
        occupied: (B,) cells that hold a particle.
        crowding: (B,) particles per occupied cell.
        peak_crowding: (B,) particles per cell in the most crowded twentieth of the occupied cells.
    """

    height: Tensor
    occupied: Tensor
    crowding: Tensor
    peak_crowding: Tensor

    @classmethod
    def concatenate(cls, shapes: Sequence[Shape]) -> Self:
        """The scenes of several ones."""
        names = [field.name for field in dataclasses.fields(cls)]
        return cls(**{name: torch.cat([getattr(shape, name) for shape in shapes]) for name in names})

    def relative_to(self, other: Shape) -> dict[str, float]:
        """Each measure, summed over scenes, over that of another shape, by name."""
        names = [field.name for field in dataclasses.fields(self)]
        return {name: float(getattr(self, name).sum() / getattr(other, name).sum()) for name in names}


def measure_shape(scene: Scene, grid: Grid, state: Particles, position: Tensor) -> Shape:
    """The shape of each scene.

    Args:
        scene: Gives the bounds.
        grid: Whose cells are counted.
        state: Gives gravity, which must not be zero, and which particles are real.
        position: (B, N, D) in domain length, all finite.
    """
    mask = state.mask.unsqueeze(-1)
    up = -torch.nn.functional.normalize(state.gravity, dim=-1)
    low, high = position.new_tensor(scene.bounds).T
    floor = torch.minimum(up * low, up * high).sum(-1)
    heights = (position * up.unsqueeze(1)).sum(-1) - floor.unsqueeze(1)
    real = state.mask.sum(1)
    counts = Nearest().p2g(mask.to(position.dtype), grid.to_cells(position), grid).flatten(1)
    occupied = (counts > 0).sum(1)
    ranked = counts.sort(dim=1, descending=True).values
    kept = (MOST_CROWDED * occupied).ceil().clamp(min=1)
    first = torch.arange(ranked.shape[1], device=ranked.device) < kept.unsqueeze(1)
    return Shape(
        height=(heights * state.mask).sum(1) / real,
        occupied=occupied.to(position.dtype),
        crowding=real / occupied,
        peak_crowding=(ranked * first).sum(1) / kept,
    )
