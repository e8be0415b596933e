"""Crowding: particles of overfull cells spread into the free volume around them, so that material keeps its volume.

φ is the volume fraction of all particles, linearly rasterised, s the solid fraction, and 1 - s a cell's free volume.
A pressure ψ on the nodes solves, approximately, the linear complementarity problem

    ψ >= 0,    φ / cap + Δψ <= 1 - s,    equality where ψ > 0,

with no flux into solids, by projected Jacobi sweeps, and particles move by -∇ψ: overfull cells empty into the nearest
free volume; particles without an overfull cell nearby do not move. All in cells; nothing is read back from the device.

Source: Kugelstadt, Longva, Thürey & Bender, Implicit Density Projection for Volume Conserving Liquids, IEEE TVCG 27
(2021), for the projection; here the density may also be lower than the cap, and one p2g and one g2p suffice a bundle.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.grid import Grid
from nmpm.transfer import Linear, is_eager_cpu, linear_g2p

MAX_SHIFT = 0.5
"""Cells that a particle moves along an axis at most: an obstacle of one cell cannot be jumped over."""

SWEEPS = 8
"""Of the Jacobi iteration: pressure reaches as many cells in a bundle."""

CLOSED = 1e-3
"""Open share of a cell's faces below which it is solid."""


@dataclass(frozen=True)
class Crowding:
    """The overfull cells of B scenes.

    Args:
        cap: Volume fraction above which a cell without solid is overfull.
        particle: Volume of a particle, as a share of a cell.
        free: (B or 1, 1, *S) share of each cell that is not solid.
        grid: The grid.
    """

    cap: float
    particle: float
    free: Tensor
    grid: Grid

    def shift(self, cells: Tensor, volume: Tensor) -> Tensor | None:
        """(B, N, D) displacements that spread overfull cells; None, on a CPU only, if there are none.

        Of positions (B, N, D) and volumes (B, N, 1), as `Particles.present_volume`. At most `MAX_SHIFT` along each
        axis, exactly zero away from overfull cells and for padding.
        """
        full = Linear().p2g(volume.to(cells.dtype), cells, self.grid) * (self.particle / self.cap)
        excess = full - self.free
        if is_eager_cpu(excess) and not bool((excess > 0).any()):
            return None
        shift = linear_g2p(self._flow(excess.flatten(1)), cells, self.grid)
        return shift.clamp(-MAX_SHIFT, MAX_SHIFT) * (volume > 0)

    def _flow(self, excess: Tensor) -> Tensor:
        """(B, D, *S) displacement at the nodes for their excess (B, size)."""
        beside, faces = self._faces(excess.dtype)
        total = faces.sum(1)
        inverse = (total > CLOSED) / total.clamp(min=CLOSED)
        share, alone = inverse.unsqueeze(1) * faces, inverse * excess
        pressure = alone.clamp(min=0)
        for _ in range(SWEEPS - 1):
            pressure = (alone + (share * pressure[:, beside]).sum(1)).clamp(min=0)
        forth, back = (faces * (pressure.unsqueeze(1) - pressure[:, beside])).unflatten(1, (-1, 2)).unbind(2)
        flow: Tensor = ((forth - back) / 2).unflatten(-1, self.grid.shape)
        return flow

    def _faces(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """The 2 D nodes beside each, after and before it along each axis, and the conductance of the faces to them.

        Indices (2 D, size) and numbers (B or 1, 2 D, size), zero at solids and walls.
        """
        grid, free = self.grid, self.free[:, 0].to(dtype)
        order = torch.arange(grid.size, device=free.device).view(grid.shape)
        beside, faces = [], []
        for axis, (spacing, wraps) in enumerate(zip(grid.spacing, grid.periodic, strict=True)):
            after = order.roll(-1, axis)
            face = torch.minimum(free, free.roll(-1, axis + 1)) * (grid.spacing[0] / spacing) ** 2
            face = face if wraps else face * (after > order)
            beside += [after, order.roll(1, axis)]
            faces += [face, face.roll(1, axis + 1)]
        return torch.stack(beside).flatten(1), torch.stack(faces, dim=1).flatten(2)
