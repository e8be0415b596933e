"""The engine of Triton kernels for rollouts on a CUDA GPU: which kernel runs when, on which memory."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
import triton
from torch import Tensor

from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.constraints import FREE_FALL_SHARE, mass_shares
from nmpm.emulator.engines.engine import Flight
from nmpm.emulator.engines.numba.parameters import KernelParameters
from nmpm.emulator.engines.torch.contact import SURFACE, obstacle_share
from nmpm.emulator.engines.torch.crowding import CLOSED, MAX_SHIFT, SWEEPS
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.emulator.engines.torch.start import BundleStart
from nmpm.emulator.engines.torch.support import ENOUGH, MAX_DROP, REACH
from nmpm.emulator.engines.triton import constraints, grid, motion
from nmpm.particles import Particles

_BLOCK = 256
"""Particles, or nodes, of a program."""

_COLUMNS = 16
"""Of cells that a program of `grid.support` treats."""


@dataclass(frozen=True)
class TritonEngine(TorchEngine):
    """Kernels in Triton around the network, for rollouts on a CUDA GPU."""

    parameters: KernelParameters
    name = "triton"

    def predict(self, particles: Particles, context: RolloutContext) -> Bundle:
        return super().predict(particles.map(Tensor.contiguous), context)

    def grid_state(self, particles: Particles, solid: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        params, materials = self.parameters, len(self.parameters.mass)
        cells, velocity, gravity = (values.contiguous() for values in self.emulator.in_cells(particles))
        sums = cells.new_zeros(len(cells), *params.shape, 3 * materials)
        grid.scatter[_programs(cells)](
            cells, velocity, particles.material, particles.mask, sums, cells.shape[1], **self._axes,
            MATERIALS=materials, BLOCK=_BLOCK,
        )  # fmt: skip
        count = sums[..., 2 * materials :]
        mean = sums[..., : 2 * materials] / torch.where(count > 0, count, 1.0).repeat_interleave(2, dim=-1)
        parts = [mean, count * params.particle_volume, solid.movedim(1, -1)]
        if params.constants:
            parts.append(gravity.unsqueeze(1).expand(-1, *params.shape, -1))
        return cells, velocity, gravity, torch.cat(parts, dim=-1).movedim(-1, 1)

    def path(self, start: BundleStart, output: Tensor, context: RolloutContext) -> Tensor:
        params, (tiles, batch), frames = self.parameters, _programs(start.cells), output.shape[1]
        path = start.cells.new_empty(batch, frames + 1, start.cells.shape[1], 2)
        sums = path.new_empty(batch, frames, tiles, motion.SUMS.value)
        share, weight = self._share(context), self._weight(start)
        self._advance(start, self.velocities(output), weight, context.budget, path, sums)
        if params.obstacles and params.solids:
            self._hold(path, weight, share, sums)
        if params.rest_speed:
            self._rest(start, path, share)
        return path[:, 1:]

    def spread(self, start: BundleStart, flight: Flight[Tensor], context: RolloutContext) -> Flight[Tensor]:
        path = flight.path
        params, (tiles, batch), frames = self.parameters, _programs(start.cells), path.shape[1]
        weight, count = self._weight(start), path.shape[2]
        path = torch.cat([start.cells.unsqueeze(1), path], dim=1)
        flow = self._flow(path, weight, context.solid)
        spreads, energies = torch.empty_like(path), path.new_empty(batch, frames + 1, tiles, 2)
        constraints.spread[tiles, batch](
            path, weight, start.gravity, self._share(context), flow, spreads, energies, frames, count, tiles,
            *self._limits, float(params.ratio[1]), **self._axes, CONTACT=params.obstacles and params.solids,
            SURFACE=SURFACE, SHIFT=MAX_SHIFT, BLOCK=_BLOCK,
        )  # fmt: skip
        if context.budget is not None:
            constraints.land[tiles, batch](
                path, spreads, energies, context.budget, frames, count, tiles, BLOCK=_BLOCK, TILES=_power(tiles)
            )
        return dataclasses.replace(flight, path=spreads[:, 1:])

    @property
    def _axes(self) -> dict[str, int]:
        """What kernels are told of the grid."""
        (nx, ny), (wx, wy) = self.parameters.shape, self.parameters.wraps
        return {"nx": nx, "ny": ny, "WX": int(wx), "WY": int(wy)}

    @property
    def _limits(self) -> tuple[float, ...]:
        """Lowest and highest position along the first and the second axis, in cells."""
        low, high, _ = self.parameters.bounds
        return float(low[0]), float(high[0]), float(low[1]), float(high[1])

    def _weight(self, start: BundleStart) -> Tensor:
        """(B, N, 1) each particle's share of its scene's mass, 0 for padding."""
        return mass_shares(self.emulator.scene, start.material, start.volume, start.cells.dtype)

    def _share(self, context: RolloutContext) -> Tensor:
        """(B, 1, *S) share of each cell's room that is obstacle; of no use where there are no obstacles."""
        walls = self.emulator.walls
        return obstacle_share(context.solid, walls).contiguous() if self.parameters.obstacles else walls

    def _advance(
        self, start: BundleStart, fields: Tensor, weight: Tensor, budget: Tensor | None, path: Tensor, sums: Tensor
    ) -> None:
        params, (batch, frames, tiles, _) = self.parameters, sums.shape
        kept, of_grid, fall, keeps = map(float, params.decoder)
        state, carried = start.state.movedim(1, -1).contiguous(), torch.empty_like(start.cells)
        for frame in range(frames + 1):
            motion.advance[tiles, batch](
                start.cells, start.velocity, start.material, weight, start.gravity, state, fields,
                sums if budget is None else budget, carried, path, sums, frame, frames, path.shape[2], tiles,
                params.channels, *self._limits, float(params.ratio[1]), *fields.stride(), **self._axes,
                MATERIALS=len(params.mass), OWN=kept, GRID=of_grid, FALL=fall, KEEPS=keeps > 0,
                LIMITED=budget is not None, FIRST=frame == 0, LAST=frame == frames, BLOCK=_BLOCK, TILES=_power(tiles),
            )  # fmt: skip

    def _hold(self, path: Tensor, weight: Tensor, share: Tensor, sums: Tensor) -> None:
        (batch, frames, tiles, _), count = sums.shape, path.shape[2]
        free = torch.empty_like(weight, dtype=torch.int32)
        way, lengths = path.new_empty(batch, 2, count, 2), path.new_empty(batch, tiles)
        options: dict[str, Any] = {"SURFACE": SURFACE, "BLOCK": _BLOCK, "STEPS": _power(tiles * frames)} | self._axes
        constraints.touch[tiles, batch](path, weight, share, sums, free, way, lengths, frames, count, tiles, **options)
        constraints.hold[tiles, batch](
            path, share, sums, free, way, lengths, frames, count, tiles, *self._limits, **options, TILES=_power(tiles)
        )

    def _rest(self, start: BundleStart, path: Tensor, share: Tensor) -> None:
        params, longest, batch = self.parameters, max(self.parameters.shape), len(path)
        held = start.mask.new_empty(batch, params.size, dtype=torch.int8)
        (left, right), (down, up) = params.floors.tolist()
        options: dict[str, Any] = {"OBSTACLES": params.obstacles, "SURFACE": SURFACE} | self._axes
        filled = start.filled(len(params.mass)).contiguous()
        grid.support[triton.cdiv(longest, _COLUMNS), batch](
            filled, share, start.gravity, held, **options, LEFT=left, RIGHT=right, DOWN=down, UP=up,
            REACH=REACH, ENOUGH=ENOUGH, ROWS=_power(longest), COLUMNS=_COLUMNS,
        )  # fmt: skip
        motion.rest[_programs(start.cells)](
            path, start.gravity, share, held, path.shape[1] - 1, path.shape[2], *self._limits, params.rest_speed,
            **options, FREE_FALL=FREE_FALL_SHARE, DROP=MAX_DROP, BLOCK=_BLOCK,
        )  # fmt: skip

    def _flow(self, path: Tensor, weight: Tensor, solid: Tensor) -> Tensor:
        """(B, *S, 2) displacements at the nodes that spread overfull cells at the path's end."""
        params, (batch, frames, count, _) = self.parameters, path.shape
        taken, per_scene = (solid, params.size) if params.solid else (self.emulator.walls, 0)
        counts = path.new_zeros(batch, *params.shape)
        constraints.count_ends[_programs(path[:, 0])](
            path, weight, counts, count, frames - 1, **self._axes, BLOCK=_BLOCK
        )
        before, after, over_nodes = torch.empty_like(counts), torch.empty_like(counts), (_blocks(params.size), batch)
        factor = 1 / float(params.ratio[1]) ** 2
        for sweep in range(SWEEPS):
            before, after = after, before
            constraints.relax[over_nodes](
                counts, taken, per_scene, before, after, params.particle_volume / params.density_cap, factor,
                **self._axes, CLOSED=CLOSED, FIRST=sweep == 0, BLOCK=_BLOCK,
            )  # fmt: skip
        flow = path.new_empty(batch, *params.shape, 2)
        constraints.find_flow[over_nodes](taken, per_scene, after, flow, factor, **self._axes, BLOCK=_BLOCK)
        return flow


def _blocks(count: int) -> int:
    return max(1, -(-count // _BLOCK))


def _programs(cells: Tensor) -> tuple[int, int]:
    """Programs of a launch over particles (B, N, D)."""
    return _blocks(cells.shape[1]), len(cells)


def _power(count: int) -> int:
    """The least power of two that is not below."""
    return 1 << (count - 1).bit_length()
