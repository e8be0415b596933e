"""Advection: moves the particles through a bundle with the grid velocities that the network predicts.

All in grid units: positions in cells, velocities in cells per frame. Nothing is read back from the device, except with
the bounds' rule "error", once per bundle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nmpm.emulator.constraints import BOUNDS, at_rest, check_within_bounds, mass_shares
from nmpm.emulator.engines.torch.contact import SURFACE, Contact, obstacle_share
from nmpm.emulator.engines.torch.crowding import Crowding
from nmpm.emulator.engines.torch.energy import EnergyLimit
from nmpm.emulator.engines.torch.support import Support, drops
from nmpm.particles import Particles
from nmpm.transfer import is_eager_cpu, linear_g2p

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator


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


@dataclass(frozen=True)
class Advection:
    """Moves an emulator's particles by what its network predicts."""

    emulator: Emulator

    def free_path(self, start: BundleStart, fields: Tensor, limit: EnergyLimit | None = None) -> Tensor:
        """(B, m, N, D) positions by the network's velocities (B, m, materials * D, *S), within the bounds.

        No frame exceeds the energy's limit, if there is one.
        """
        decoder, gravity = self.emulator.decoder, start.gravity
        smoothed = self.gather(start.state[:, : fields.shape[2]], start.cells, start.material)
        carried = decoder.carried_velocity(start.velocity, smoothed)
        cells, velocity, before, path = start.cells, carried, start.velocity, []
        for frame, field in enumerate(fields.unbind(1), start=1):  # indexing would cost a zero-fill each, backwards
            step = decoder.known_velocity(carried, velocity, gravity, frame) + self.gather(field, cells, start.material)
            arrived = self._confine(cells + step)
            if limit is not None:
                arrived = self._shorten(limit, cells, arrived, before)
            velocity = before = arrived - cells
            cells = arrived
            path.append(cells)
        return torch.stack(path, dim=1)

    def constrained_path(self, start: BundleStart, fields: Tensor, solid: Tensor, budget: Tensor | None) -> Tensor:
        """(B, m, N, D) positions that obey the constraints; solid and budget are those of the `RolloutContext`."""
        path = self.free_path(start, fields, self._limit(start, budget))
        obstacle = obstacle_share(solid, self.emulator.walls) if self.emulator.scene.obstacles else None
        if self.emulator.constraints.solids and obstacle is not None:
            path = self._keep_clear(start, path, obstacle)
        if self.emulator.constraints.rest_speed:
            path = self._bring_to_rest(start, path, obstacle)
        return path

    def spread_path(self, start: BundleStart, path: Tensor, solid: Tensor, budget: Tensor | None) -> Tensor:
        """A path (B, m, N, D) of `constrained_path` with overfull cells at its end spread, evenly over its frames."""
        emulator = self.emulator
        volume = emulator.scene.particle_volume / emulator.grid.cell_volume
        solid = solid if start.solids is None else start.solids[:, -1:]
        taken = solid if solid.shape[1] else emulator.walls.expand(1, 1, *emulator.grid.shape)
        crowding = Crowding(emulator.constraints.density_cap, volume, 1 - taken, emulator.grid)
        shift = crowding.shift(path[:, -1], start.volume.unsqueeze(-1))
        if shift is None:
            return path
        frames = path.shape[1]
        ramp = torch.arange(1, frames + 1, device=path.device, dtype=path.dtype).view(-1, 1, 1) / frames
        spread = self._confine(torch.addcmul(path, ramp, shift.unsqueeze(1)))
        if emulator.constraints.solids and emulator.scene.obstacles:
            obstacle = obstacle_share(solid, emulator.walls).to(path.dtype)
            depth = linear_g2p(obstacle, spread.flatten(1, 2), emulator.grid)
            blocked = (depth > SURFACE).unflatten(1, path.shape[1:3]).any(1, keepdim=True)
            spread = torch.where(blocked, path, spread)
        if (limit := self._limit(start, budget)) is None:
            return spread
        ends = emulator.grid.isotropic_units(start.cells, path, spread)
        return torch.lerp(path, spread, limit.share_within(*ends).view(-1, 1, 1, 1))

    def gather(self, fields: Tensor, cells: Tensor, material: Tensor) -> Tensor:
        """Each particle's own material's values: fields (B, materials * V, *S) at cells (B, N, D) → (B, N, V)."""
        gathered = self.emulator.transfer.g2p(fields, cells, self.emulator.grid)
        if len(self.emulator.scene.materials) == 1:
            return gathered
        by_material = gathered.unflatten(-1, (len(self.emulator.scene.materials), -1))
        index = material[..., None, None].expand(-1, -1, 1, by_material.shape[-1])
        values: Tensor = by_material.gather(2, index).squeeze(2)
        return values

    def check_bounds(self, start: BundleStart, path: Tensor) -> None:
        """Raise DataError if a particle leaves the bounds by more than a cell, and their rule is "error"."""
        if self.emulator.constraints.bounds == "error":
            check_within_bounds(path, start.mask, self.emulator.bounds, self.emulator.scene.confined)

    def _limit(self, start: BundleStart, budget: Tensor | None) -> EnergyLimit | None:
        if budget is None:
            return None
        share = mass_shares(self.emulator.scene, start.material, start.volume, start.cells.dtype)
        (gravity,) = self.emulator.grid.isotropic_units(start.gravity)
        return EnergyLimit(gravity, share, budget)

    def _shorten(self, limit: EnergyLimit, cells: Tensor, arrived: Tensor, before: Tensor) -> Tensor:
        """(B, N, D) positions after a frame within the energy, on the way from cells to those proposed (B, N, D)."""
        excess = limit.excess(*self.emulator.grid.isotropic_units(cells, arrived - cells, before))
        return arrived if excess is None else self._confine(torch.lerp(arrived, cells, excess))

    def _keep_clear(self, start: BundleStart, path: Tensor, obstacle: Tensor) -> Tensor:
        """The path (B, m, N, D) outside of obstacles; of those that move, where they are in each frame."""
        if start.solids is None:
            return self._confine(Contact(obstacle, self.emulator.grid).hold(start.cells, path, start.mask))
        cells, held = start.cells, []
        steps = path.diff(dim=1, prepend=cells.unsqueeze(1))
        for step, there in zip(steps.unbind(1), start.solids.unsqueeze(2).unbind(1), strict=True):
            contact = Contact(obstacle_share(there, self.emulator.walls), self.emulator.grid)
            cells = self._confine(contact.hold(cells, (cells + step).unsqueeze(1), start.mask)).squeeze(1)
            held.append(cells)
        return torch.stack(held, dim=1)

    def _bring_to_rest(self, start: BundleStart, path: Tensor, obstacle: Tensor | None) -> Tensor:
        """The path (B, m, N, D), on which particles at rest stay if something holds them up, and fall otherwise."""
        emulator = self.emulator
        still = at_rest(start.cells, path, emulator.constraints.rest_speed, start.gravity)
        if is_eager_cpu(still) and not bool(still.any()):
            return path
        support = Support(start.filled(len(emulator.scene.materials)), obstacle, emulator.scene, emulator.grid)
        fallen = start.cells.unsqueeze(1) + drops(start.gravity, path.shape[1])
        held = support.holds(start.cells, fallen[:, -1], start.gravity)[:, None, :, None]
        resting = torch.where(held, start.cells.unsqueeze(1), self._confine(fallen))
        return torch.where(still[:, None, :, None], resting, path)

    def _confine(self, cells: Tensor) -> Tensor:
        """Positions (..., D) within the walls; other axes have none (periodic ones are unwrapped: transfers wrap)."""
        rule, (low, high) = BOUNDS[self.emulator.constraints.bounds], self.emulator.bounds.unbind(0)
        confined = self.emulator.scene.confined
        if not any(confined):
            return cells
        if all(confined):
            return rule(cells, low, high)
        columns = [
            rule(column, low[axis], high[axis]) if walls else column
            for axis, (column, walls) in enumerate(zip(cells.unbind(-1), confined, strict=True))
        ]
        return torch.stack(columns, dim=-1)
