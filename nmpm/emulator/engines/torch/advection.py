"""Advection: moves the particles through a bundle with the grid velocities that the network predicts.

All in grid units: positions in cells, velocities in cells per frame. Nothing is read back from the device, except with
the bounds' rule "error", once per bundle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nmpm.emulator.constraints import (
    BOUNDS,
    affordable,
    affordable_share,
    at_rest,
    check_within_bounds,
    energy,
    mass_shares,
)
from nmpm.emulator.engines.torch.contact import SURFACE, Contact, obstacle_share
from nmpm.emulator.engines.torch.crowding import Crowding
from nmpm.emulator.engines.torch.start import BundleStart
from nmpm.emulator.engines.torch.support import Support
from nmpm.transfer.execution import is_eager_cpu
from nmpm.transfer.linear import linear_g2p

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator


@dataclass(frozen=True)
class MovingParticles:
    """Particles on their way through a bundle.

    Args:
        start: Where they are at its start.
        carried: (B, N, D) velocities that the decoder lets particles keep.
        fields: (B, m, materials * D, *S), what the network predicts.
        share: (B, N, 1) each particle's share of its scene's mass, 0 for padding.
    """

    start: BundleStart
    carried: Tensor
    fields: Tensor
    share: Tensor


@dataclass(frozen=True)
class Advection:
    """Moves an emulator's particles by what its network predicts."""

    emulator: Emulator

    def free_path(self, start: BundleStart, fields: Tensor) -> Tensor:
        """(B, m, N, D) positions by the network's velocities alone, within the bounds; raises as `constrained_path`."""
        return self._check_bounds(start, self._free_path(self._take_off(start, fields)))

    def constrained_path(self, start: BundleStart, fields: Tensor, solid: Tensor, budget: Tensor | None) -> Tensor:
        """(B, m, N, D) positions that obey the constraints.

        Solid and budget are those of the `RolloutContext`. Raises DataError if a particle leaves the bounds by more
        than a cell, and their rule is "error".
        """
        moving = self._take_off(start, fields)
        path = self._free_path(moving) if budget is None else self._within_energy(moving, budget)
        if self.emulator.constraints.solids and self.emulator.scene.obstacles:
            path = self._keep_clear(start, path, solid)
        if self.emulator.constraints.rest_speed:
            path = self._bring_to_rest(start, path, solid)
        return self._check_bounds(start, path)

    def _keep_clear(self, start: BundleStart, path: Tensor, solid: Tensor) -> Tensor:
        """The path (B, m, N, D) outside of obstacles; of those that move, where they are in each frame."""
        if start.solids is None:
            contact = Contact(obstacle_share(solid, self.emulator.walls), self.emulator.grid)
            return self._confine(contact.hold(start.cells, path, start.mask))
        cells, held = start.cells, []
        steps = path.diff(dim=1, prepend=cells.unsqueeze(1))
        for step, there in zip(steps.unbind(1), start.solids.unsqueeze(2).unbind(1), strict=True):
            contact = Contact(obstacle_share(there, self.emulator.walls), self.emulator.grid)
            cells = self._confine(contact.hold(cells, (cells + step).unsqueeze(1), start.mask)).squeeze(1)
            held.append(cells)
        return torch.stack(held, dim=1)

    def uncrowded_path(self, start: BundleStart, path: Tensor, solid: Tensor, budget: Tensor | None) -> Tensor:
        """A path (B, m, N, D) of `constrained_path` with overfull cells at its end spread, evenly over its frames."""
        volume = self.emulator.scene.particle_volume / self.emulator.grid.cell_volume
        solid = solid if start.solids is None else start.solids[:, -1:]
        taken = solid if solid.shape[1] else self.emulator.walls.expand(1, 1, *self.emulator.grid.shape)
        crowding = Crowding(self.emulator.constraints.density_cap, volume, 1 - taken, self.emulator.grid)
        shift = crowding.shift(path[:, -1], start.volume.unsqueeze(-1))
        if shift is None:
            return path
        frames = path.shape[1]
        ramp = torch.arange(1, frames + 1, device=path.device, dtype=path.dtype).view(-1, 1, 1) / frames
        spread = self._confine(path + ramp * shift.unsqueeze(1))
        if self.emulator.constraints.solids and self.emulator.scene.obstacles:
            depth = linear_g2p(
                obstacle_share(solid, self.emulator.walls).to(path.dtype), spread.flatten(1, 2), self.emulator.grid
            )
            blocked = (depth > SURFACE).unflatten(1, path.shape[1:3]).any(1, keepdim=True)
            spread = torch.where(blocked, path, spread)
        return spread if budget is None else self._afford_spread(start, path, spread, budget)

    def gather(self, fields: Tensor, cells: Tensor, material: Tensor) -> Tensor:
        """Each particle's own material's values: fields (B, materials * V, *S) at cells (B, N, D) → (B, N, V)."""
        gathered = self.emulator.transfer.g2p(fields, cells, self.emulator.grid)
        if len(self.emulator.scene.materials) == 1:
            return gathered
        by_material = gathered.unflatten(-1, (len(self.emulator.scene.materials), -1))
        index = material[..., None, None].expand(-1, -1, 1, by_material.shape[-1])
        values: Tensor = by_material.gather(2, index).squeeze(2)
        return values

    def _take_off(self, start: BundleStart, fields: Tensor) -> MovingParticles:
        """The velocities that particles keep, and their shares of their scene's mass."""
        smoothed = self.gather(start.state[:, : fields.shape[2]], start.cells, start.material)
        carried = self.emulator.decoder.carried_velocity(start.velocity, smoothed)
        share = mass_shares(self.emulator.scene, start.material, start.volume, start.cells.dtype)
        return MovingParticles(start, carried, fields, share)

    def _free_path(self, moving: MovingParticles) -> Tensor:
        """(B, m, N, D) positions, frame by frame."""
        cells, velocity, path = moving.start.cells, moving.carried, []
        fields = moving.fields.unbind(1)  # indexing would cost a zero-fill each, backwards
        for frame, field in enumerate(fields, start=1):
            arrived = self._advance(moving, field, cells, velocity, frame)
            velocity, cells = arrived - cells, arrived
            path.append(cells)
        return torch.stack(path, dim=1)

    def _advance(self, moving: MovingParticles, field: Tensor, cells: Tensor, velocity: Tensor, frame: int) -> Tensor:
        """(B, N, D) positions after a frame, from cells (B, N, D) and the velocity (B, N, D) of the frame before."""
        known = self.emulator.decoder.known_velocity(moving.carried, velocity, moving.start.gravity, frame)
        return self._confine(cells + (known + self.gather(field, cells, moving.start.material)))

    def _within_energy(self, moving: MovingParticles, budget: Tensor) -> Tensor:
        """(B, m, N, D) positions of which no frame exceeds an energy (B,).

        On a CPU the free path is tried first, and kept up to the first frame that exceeds the energy, if any does.
        """
        if not is_eager_cpu(budget):
            return self._limit_energy(moving, budget, moving.start.cells.unsqueeze(1)[:, :0])
        path = self._free_path(moving)
        energies = self._energies(moving.start.cells, moving.start.gravity, moving.share, path)
        exceeds = (energies > budget.unsqueeze(1)).any(0)
        if not bool(exceeds.any()):
            return path
        return self._limit_energy(moving, budget, path[:, : int(exceeds.int().argmax())])

    def _energies(self, cells: Tensor, gravity: Tensor, share: Tensor, path: Tensor) -> Tensor:
        """(B, m) energies of the frames of a path (B, m, N, D) from cells (B, N, D), with shares (B, N, 1) of mass."""
        steps = path.diff(dim=1, prepend=cells.unsqueeze(1))
        path, steps, gravity = self.emulator.grid.isotropic_units(path, steps, gravity)
        return energy(path, steps, gravity, share)

    def _limit_energy(self, moving: MovingParticles, budget: Tensor, begun: Tensor) -> Tensor:
        """(B, m, N, D) positions, each frame within an energy (B,), after the first frames (B, f, N, D), which are."""
        path = [moving.start.cells, *begun.unbind(1)]
        velocity, before = moving.carried, moving.start.velocity
        if len(path) > 1:
            velocity = before = path[-1] - path[-2]
        for frame, field in enumerate(moving.fields.unbind(1)[len(path) - 1 :], start=len(path)):
            cells = path[-1]
            proposed = self._advance(moving, field, cells, velocity, frame)
            step = proposed - cells
            units, steps, last, gravity = self.emulator.grid.isotropic_units(cells, step, before, moving.start.gravity)
            factor = affordable(units, steps, last, gravity, moving.share, budget)
            arrived = torch.where(factor < 1, self._confine(cells + factor * step), proposed)
            velocity = before = arrived - cells
            path.append(arrived)
        return torch.stack(path[1:], dim=1)

    def _bring_to_rest(self, start: BundleStart, path: Tensor, solid: Tensor) -> Tensor:
        """The path (B, m, N, D), on which particles at rest stay if something holds them up, and fall otherwise."""
        still = at_rest(start.cells, path, self.emulator.constraints.rest_speed, start.gravity)
        if is_eager_cpu(still) and not bool(still.any()):
            return path
        obstacle = obstacle_share(solid, self.emulator.walls) if self.emulator.scene.obstacles else None
        support = Support(
            start.filled(len(self.emulator.scene.materials)), obstacle, self.emulator.scene, self.emulator.grid
        )
        held = support.holds(start.cells, start.gravity)[:, None, :, None]
        fallen = self._confine(support.fall(start.cells, start.gravity, path.shape[1]))
        return torch.where(still[:, None, :, None], torch.where(held, start.cells.unsqueeze(1), fallen), path)

    def _afford_spread(self, start: BundleStart, path: Tensor, spread: Tensor, budget: Tensor) -> Tensor:
        """The largest part of the way from path to spread (B, m, N, D) that no frame's energy (B,) forbids.

        The state after the bundle, which keeps the path's velocity, counts as a further frame.
        """
        after = self._spread_energies(start, path, spread)
        if is_eager_cpu(budget) and not bool((after > budget.unsqueeze(1)).any()):
            return spread
        share = affordable_share(self._spread_energies(start, path, path), after, budget)[:, None, None, None]
        return torch.where(share < 1, path + share * (spread - path), spread)

    def _spread_energies(self, start: BundleStart, path: Tensor, spread: Tensor) -> Tensor:
        """(B, m + 1) energies of the frames of a spread path, and of its end with the velocity of the path's end."""
        share = mass_shares(self.emulator.scene, start.material, start.volume, start.cells.dtype)
        before = path[:, -2] if path.shape[1] > 1 else start.cells
        cells, step, gravity = self.emulator.grid.isotropic_units(spread[:, -1], path[:, -1] - before, start.gravity)
        end = energy(cells, step, gravity, share)
        return torch.cat([self._energies(start.cells, start.gravity, share, spread), end.unsqueeze(1)], dim=1)

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

    def _check_bounds(self, start: BundleStart, path: Tensor) -> Tensor:
        if self.emulator.constraints.bounds == "error":
            check_within_bounds(path, start.mask, self.emulator.bounds, self.emulator.scene.confined)
        return path
