"""What a bundle starts from, in grid units: positions in cells, velocities in cells per frame."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class BundleStart:
    """The particles at the start of a bundle and the grids around them.

    Args:
        cells: (B, N, D) positions.
        velocity: (B, N, D) the particles' own velocities.
        gravity: (B, 1, D), what a frame adds to a velocity.
        material: (B, N) indices into the scene's materials.
        mask: (B, N) bool, False for padding.
        state: (B, C_in, *S), what the network has seen; velocities first, as in `output`.
        output: (B, m, C, *S), what the network predicts, C = materials * D; of its own precision.
        scale: (m, C, 1, ...), by which it is multiplied.
    """

    cells: Tensor
    velocity: Tensor
    gravity: Tensor
    material: Tensor
    mask: Tensor
    state: Tensor
    output: Tensor
    scale: Tensor

    @property
    def fields(self) -> Tensor:
        """(B, m, C, *S), the predicted velocities, of the scale's precision."""
        return self.output.to(torch.promote_types(self.scale.dtype, torch.float32)) * self.scale

    @property
    def filled(self) -> Tensor:
        """(B, 1, *S), the volume fraction of all materials that the network has seen."""
        materials = self.output.shape[2] // self.cells.shape[-1]
        return self.state[:, self.output.shape[2] : self.output.shape[2] + materials].sum(1, keepdim=True)
