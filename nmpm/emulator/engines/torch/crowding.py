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

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.grid import Grid
from nmpm.transfer import Linear
from nmpm.transfer.execution import is_eager_cpu
from nmpm.transfer.linear import linear_g2p

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
        flow = torch.cat(self._flow(excess), dim=1)
        shift = linear_g2p(flow, cells, self.grid)
        return torch.where(volume > 0, shift.clamp(-MAX_SHIFT, MAX_SHIFT), 0.0)

    def _flow(self, excess: Tensor) -> list[Tensor]:
        """Displacement at the nodes along each axis, D tensors (B, 1, *S), for their excess (B, 1, *S)."""
        faces = self._faces(excess.dtype)
        diagonal = sum((face + _roll(face, 1, axis) for axis, face in enumerate(faces)), start=excess.new_zeros(()))
        inverse = torch.where(diagonal > CLOSED, 1 / diagonal.clamp(min=CLOSED), 0.0)
        pressure = (inverse * excess).clamp(min=0)
        for _ in range(SWEEPS - 1):
            left = excess
            for axis, flux in enumerate(_fluxes(pressure, faces)):
                left = left - flux + _roll(flux, 1, axis)
            pressure = (pressure + inverse * left).clamp(min=0)
        return [(flux + _roll(flux, 1, axis)) / 2 for axis, flux in enumerate(_fluxes(pressure, faces))]

    def _faces(self, dtype: torch.dtype) -> list[Tensor]:
        """For each axis the conductance of the faces (B or 1, 1, *S) from each node to the next; zero at solids."""
        first, faces = self.grid.spacing[0], []
        for axis, (spacing, extent) in enumerate(zip(self.grid.spacing, self.grid.shape, strict=True)):
            free = self.free.to(dtype)
            face = torch.minimum(free, _roll(free, -1, axis)) * (first / spacing) ** 2
            if not self.grid.periodic[axis]:
                last = torch.arange(extent, device=face.device) == extent - 1
                face = torch.where(last.view(-1, *(1,) * (self.grid.dim - 1 - axis)), 0.0, face)
            faces.append(face)
        return faces


def _fluxes(pressure: Tensor, faces: Sequence[Tensor]) -> list[Tensor]:
    """For each axis the displacement through the faces from each node to the next."""
    return [face * (pressure - _roll(pressure, -1, axis)) for axis, face in enumerate(faces)]


def _roll(values: Tensor, by: int, axis: int) -> Tensor:
    """Values (B, C, *S) moved along one of the grid's axes, around its ends."""
    return torch.roll(values, by, axis + 2)
