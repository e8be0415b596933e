"""What a bundle starts from, as tensors."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from nmpm.particles import Particles


@dataclass(frozen=True)
class BundleStart:
    """The particles at the start of a bundle and the grids around them, in cells and cells per frame.

    Args:
        particles: The state, in domain length.
        cells: (B, N, D) positions.
        velocity: (B, N, D) the particles' own velocities.
        gravity: (B, 1, D), what a frame adds to a velocity.
        state: (B, C_in, *S), what the network sees; velocities of all materials first, then their volume fractions.
        solids: (B, m, *S) solid fraction at each of the frames, where obstacles move; None where they do not.
    """

    particles: Particles
    cells: Tensor
    velocity: Tensor
    gravity: Tensor
    state: Tensor
    solids: Tensor | None = None

    @property
    def material(self) -> Tensor:
        """(B, N) indices into the scene's materials."""
        return self.particles.material

    @property
    def mask(self) -> Tensor:
        """(B, N) bool, False for padding."""
        return self.particles.mask

    @property
    def volume(self) -> Tensor:
        """(B, N) as `Particles.present_volume`."""
        return self.particles.present_volume

    def filled(self, materials: int) -> Tensor:
        """(B, 1, *S), the volume fraction of all materials that the network has seen."""
        first = materials * self.cells.shape[-1]
        return self.state[:, first : first + materials].sum(1, keepdim=True)
