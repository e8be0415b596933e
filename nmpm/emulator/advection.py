"""How particles move through a bundle, once the network has said what the grid's velocities are.

All in grid units: positions in cells, velocities in cells per frame.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.decoders import Decoder
from nmpm.emulator.constraints import BOUNDS, Constraints, affordable, at_rest, energy, otherwise_if
from nmpm.emulator.contact import Contact
from nmpm.grid import Grid
from nmpm.scene import Scene
from nmpm.transfer import Transfer
from nmpm.transfer.pieces import pieces


@dataclass(frozen=True)
class Flight:
    """What one bundle's frames start from.

    Args:
        cells: (B, N, D) positions.
        carried: (B, N, D) velocities that the decoder lets particles keep.
        gravity: (B, 1, D), what a frame adds to a velocity.
        material: (B, N) indices into the scene's materials.
        fields: (B, m, materials * D, *S), what the network predicts.
        share: (B, N) weights of the particles in sums over a scene, 0 for padding.
    """

    cells: Tensor
    carried: Tensor
    gravity: Tensor
    material: Tensor
    fields: Tensor
    share: Tensor

    def part(self, piece: slice) -> Flight:
        """The same for a piece of the particles."""
        own = {name: getattr(self, name)[:, piece] for name in ("cells", "carried", "material", "share")}
        return dataclasses.replace(self, **own)


@dataclass(frozen=True)
class Advection:
    """Moves the particles of one family of scenes over one grid.

    Args:
        scene: Says which axes are periodic, which materials there are, and whether obstacles can be.
        grid: Where the predicted velocities live.
        transfer: How they come to the particles.
        decoder: What they mean.
        constraints: What no frame may do.
        bounds: (2, D), the lowest and highest positions.
        walls: (1, C_solid, *S), what of each cell is wall.
    """

    scene: Scene
    grid: Grid
    transfer: Transfer
    decoder: Decoder
    constraints: Constraints
    bounds: Tensor
    walls: Tensor

    def free(self, flight: Flight) -> Tensor:
        """(B, m, N, D) positions by the network's velocities alone, within the walls."""
        parts = [self._path(flight.part(piece)) for piece in pieces(flight.cells.shape[1], flight.cells.device)]
        return torch.cat(parts, dim=2) if len(parts) > 1 else parts[0]

    def constrained(self, flight: Flight, solid: Tensor, budget: Tensor | None) -> Tensor:
        """(B, m, N, D) positions as the constraints let them be.

        Args:
            flight: What to start from.
            solid: (B, C_solid, *S), what of each cell is wall or obstacle.
            budget: (B,) energy that no frame may exceed; None for no such limit.
        """
        path = self._clear(flight, self.free(flight), solid)
        if budget is not None:
            steps = path.diff(dim=1, prepend=flight.cells.unsqueeze(1))
            spent = energy(*self.grid.alike(path, steps, flight.gravity), flight.share)
            # Seldom: then all frames once more, each within it.
            excess = (spent > budget.unsqueeze(1)).any()
            path = otherwise_if(excess, lambda: self._clear(flight, self._path(flight, budget), solid), path)
        if self.constraints.rest_speed:
            still = at_rest(flight.cells, path, self.constraints.rest_speed, flight.gravity)
            path = torch.where(still[:, None, :, None], flight.cells.unsqueeze(1), path)
        return path

    def gather(self, fields: Tensor, cells: Tensor, material: Tensor) -> Tensor:
        """Each particle's own material's velocity: fields (B, materials * D, *S) at cells (B, N, D) → (B, N, D)."""
        gathered = self.transfer.g2p(fields, cells, self.grid)
        if len(self.scene.materials) == 1:
            return gathered
        split = gathered.unflatten(-1, (len(self.scene.materials), self.scene.dim))
        chosen = material[..., None, None].expand(-1, -1, 1, self.scene.dim)
        own: Tensor = split.gather(2, chosen).squeeze(2)
        return own

    def _path(self, flight: Flight, budget: Tensor | None = None) -> Tensor:
        """(B, m, N, D) positions, within an energy (B,) if one is given."""
        cells, velocity, path = flight.cells, flight.carried, []
        fields = flight.fields.unbind(1)  # indexing would cost a zero-fill each, backwards
        for frame, field in enumerate(fields, start=1):
            known = self.decoder.known(flight.carried, velocity, flight.gravity, frame)
            step = known + self.gather(field, cells, flight.material)
            if budget is not None:
                step = step * affordable(*self.grid.alike(cells, step, flight.gravity), flight.share, budget)
            arrived = self._confined(cells + step)
            velocity = arrived - cells
            cells = arrived
            path.append(cells)
        return torch.stack(path, dim=1)

    def _clear(self, flight: Flight, path: Tensor, solid: Tensor) -> Tensor:
        """The path (B, m, N, D), clear of obstacles."""
        if not (self.constraints.solids and self.scene.obstacles):
            return path
        room = 1 - self.walls
        share = torch.where(room > 0, (solid - self.walls) / room.clamp(min=1e-6), 0.0).clamp(0, 1)
        return self._confined(Contact(share, self.grid).hold(flight.cells, path))

    def _confined(self, cells: Tensor) -> Tensor:
        """Within the walls; periodic axes go on (positions there are unwrapped, transfers wrap)."""
        if all(self.scene.periodic):
            return cells
        low, high = self.bounds
        rule = BOUNDS[self.constraints.bounds]
        if not any(self.scene.periodic):
            return rule(cells, low, high)
        wraps = torch.tensor(self.scene.periodic, device=cells.device)
        return torch.where(wraps, cells, rule(torch.where(wraps, (low + high) / 2, cells), low, high))
