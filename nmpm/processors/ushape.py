"""The U shape: level by level down to coarser grids and up again, each level's result added on the way up."""

from __future__ import annotations

from collections.abc import Iterable

from torch import Tensor, nn


class UShape(nn.Module):
    """Levels of which each works on a grid half as fine as the one before.

    Args:
        down: What each level does on the way down, the finest first.
        coarsen: From each level's grid to the next, one fewer.
        up: What each level but the coarsest does on the way up, the finest first.
        refine: Back from the next level's grid to each, likewise.
    """

    def __init__(
        self,
        down: Iterable[nn.Module],
        coarsen: Iterable[nn.Module],
        up: Iterable[nn.Module],
        refine: Iterable[nn.Module],
    ) -> None:
        super().__init__()
        self.down, self.coarsen = nn.ModuleList(down), nn.ModuleList(coarsen)
        self.up, self.refine = nn.ModuleList(up), nn.ModuleList(refine)

    def forward(self, hidden: Tensor) -> Tensor:
        """Map (B, C, *S) to the same shape; each side of S a multiple of 2 ** (levels - 1)."""
        hidden = self.down[0](hidden)
        skips: list[Tensor] = []
        for coarsen, level in zip(self.coarsen, list(self.down)[1:], strict=True):
            skips.append(hidden)
            hidden = level(coarsen(hidden))
        for refine, level in zip(reversed(self.refine), reversed(self.up), strict=True):
            hidden = level(skips.pop() + refine(hidden))
        return hidden


def upsample_nearest() -> nn.Module:
    """Upsampling that repeats each cell twice along each axis."""
    return nn.Upsample(scale_factor=2.0, mode="nearest")


def ushape_radius(depth: int, level: int, bottom: int, between: int) -> int:
    """Radius in cells of levels of convolutions in a U shape, see `GridProcessor.radius`.

    Args:
        depth: Number of down-samplings by 2.
        level: Cells that the convolutions of a level but the coarsest reach, on the way down and on the way up each.
        bottom: Cells that those of the coarsest level reach.
        between: Cells that a step to the coarser level and back reaches; of these, the strided convolution has 1.5.
    """
    coarsest = 1 << depth
    return (coarsest - 1) * (2 * level + between) + coarsest * bottom
