"""The engine of Triton kernels for rollouts on a CUDA GPU: which kernel runs when, on which memory."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.constraints import FREE_FALL_SHARE, mass_shares
from nmpm.emulator.engines.engine import Engine, Flight
from nmpm.emulator.engines.torch.advection import BundleStart
from nmpm.emulator.engines.torch.contact import SURFACE
from nmpm.emulator.engines.torch.crowding import CLOSED, MAX_SHIFT, SWEEPS
from nmpm.emulator.engines.torch.support import ENOUGH, MAX_DROP, REACH
from nmpm.particles import Particles
from nmpm_triton import contact, crowding, grid, launch, motion, rest
from nmpm_triton.launch import axes, blocks, decoding, power, programs, walls, warps, whole

_COLUMNS = 16
"""Of cells that a program of `rest.support` treats."""


@dataclass(frozen=True, kw_only=True)
class TritonStart(BundleStart):
    """A bundle's start, with what kernels fill in beside it.

    Args:
        seen: (B, C_in, *S), the network's input.
        share: (B, *S) share of each cell's room that is obstacle; of no use where there are no obstacles.
        path: (B, m + 1, N, 2), whose first frame is the start; the others are filled in flight.
    """

    seen: Tensor
    share: Tensor
    path: Tensor


class TritonEngine(Engine[TritonStart, Tensor]):
    """Kernels in Triton around the network, for rollouts on a CUDA GPU.

    Scenes of at most `launch.ONE_PROGRAM` particles take one launch for all frames, larger ones one for each.
    """

    name = "triton"

    def rasterise(self, particles: Particles, context: RolloutContext) -> TritonStart:
        particles = particles.map(Tensor.contiguous)
        params, model, (batch, count, _) = self.parameters, self.emulator, particles.position.shape
        path = model.walls.new_empty(batch, model.frames + 1, count, 2)
        velocity, gravity = path.new_empty(batch, count, 2), path.new_empty(batch, 1, 2)
        sums, materials = path.new_zeros(batch, *params.shape, 3 * len(params.mass)), len(params.mass)
        grid.scatter[programs(velocity)](
            particles.position, particles.velocity, particles.gravity, particles.material, particles.present_volume,
            path, velocity, gravity, sums, count, path.stride(0) // 2, *self._box, **self._axes, MATERIALS=materials,
            CONVERT=True, BLOCK=launch.BLOCK,
        )  # fmt: skip
        state, seen = path.new_empty(2, batch, *params.shape, params.channels)
        share = path.new_empty(batch, *params.shape) if params.obstacles else model.walls
        grid.fill_state[blocks(params.size), batch](
            sums, *self._taken(context), model.walls, gravity, model.input_low, model.input_high, model.input_mean,
            model.input_std, state, seen, share, params.particle_volume, params.channels, params.size,
            MATERIALS=materials, SOLID=int(params.solid), CONSTANTS=params.constants, OBSTACLES=params.obstacles,
            SEEN=True, BLOCK=launch.BLOCK,
        )  # fmt: skip
        state, seen = state.movedim(-1, 1), seen.movedim(-1, 1)
        return TritonStart(particles, path[:, 0], velocity, gravity, state, seen=seen, share=share, path=path)

    def normalise(self, start: TritonStart, context: RolloutContext) -> Tensor:  # noqa: ARG002 (other engines')
        return start.seen

    def fly(self, start: TritonStart, output: Tensor, context: RolloutContext) -> Flight[Tensor]:
        path, params = start.path, self.parameters
        fits = context.budget is None or path.shape[2] <= launch.ONE_PROGRAM
        squares = (self._move if fits else self._move_tiles)(start, output, context.budget)
        if params.obstacles and params.solids:
            self._hold(start, squares)
        if params.rest_speed:
            self._rest(start)
        return Flight(path[:, 1:], path[:, -1] - path[:, -2])

    def spread(self, start: TritonStart, flight: Flight[Tensor], context: RolloutContext) -> Flight[Tensor]:
        small = self.parameters.size <= launch.ONE_PROGRAM
        flow = (self._flow if small else self._flow_tiles)(start, context)
        few = start.path.shape[2] <= launch.ONE_PROGRAM
        spreads = (self._spread if few else self._spread_tiles)(start, flow, context.budget)
        return dataclasses.replace(flight, path=spreads[:, 1:])

    def land(self, start: TritonStart, flight: Flight[Tensor]) -> Bundle:
        (batch, frames, count, _), like = flight.path.shape, start.particles.position
        position, velocity = like.new_empty(batch, frames, count, 2), torch.empty_like(like)
        motion.land[programs(velocity)](
            flight.path, flight.step, position, velocity, frames, count, flight.path.stride(0), *self._box,
            BLOCK=launch.BLOCK,
        )  # fmt: skip
        return Bundle(position, velocity)

    @property
    def _axes(self) -> dict[str, int]:
        return axes(self.parameters.shape, self.parameters.wraps)

    @property
    def _box(self) -> list[float]:
        """The grid's lower corner and the cells' widths."""
        corner: list[float] = self.parameters.box.flatten().tolist()
        return corner

    @property
    def _limits(self) -> tuple[float, ...]:
        """Lowest and highest position along the first and the second axis, in cells."""
        low, high, _ = self.parameters.bounds
        return float(low[0]), float(high[0]), float(low[1]), float(high[1])

    @property
    def _masses(self) -> tuple[float, ...]:
        """Of a particle of each material, relative to the largest; one where all are alike."""
        masses = self.parameters.mass.tolist()
        return tuple(mass / max(masses) for mass in masses) if len(set(masses)) > 1 else (1.0,)

    def _taken(self, context: RolloutContext) -> tuple[Tensor, int]:
        """Share of each cell that is wall or obstacle, and how far scenes are apart."""
        if not self.parameters.solid:
            return self.emulator.walls, 0
        solid = context.solid if context.solid[:1, 0].is_contiguous() else context.solid.contiguous()
        return solid, solid.stride(0)

    def _weight(self, start: TritonStart) -> Tensor:
        """(B, N, 1) each particle's share of its scene's mass, 0 for padding."""
        return mass_shares(self.emulator.scene, start.material, start.volume, start.velocity.dtype)

    def _moving(self, output: Tensor) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """What kernels that move particles are told of the output and of the emulator."""
        params, model = self.parameters, self.emulator
        numbers = params.channels, output.shape[2], *output.stride(), *model.bounds.stride(), float(params.ratio[1])
        options = {"MATERIALS": len(params.mass)} | self._axes | walls(model.scene.confined) | decoding(params.decoder)
        return numbers, options

    def _move(self, start: TritonStart, output: Tensor, budget: Tensor | None) -> Tensor:
        """Fill in the path; (B, programs) squares of the longest steps."""
        model, (batch, _, count, _) = self.emulator, start.path.shape
        block, path = launch.BLOCK if budget is None else whole(count), start.path[:, 1:]
        squares = path.new_empty(batch, -(-count // block))
        numbers, options = self._moving(output)
        motion.flight[squares.shape[1], batch](
            start.path, start.velocity, start.material, start.volume, start.gravity, start.state, output,
            model.output_scale, squares if budget is None else budget, model.bounds, path, squares, path.shape[1],
            count, start.path.stride(0) // 2, path.stride(0) // 2, *numbers, **options, LIMITED=budget is not None,
            MASSES=self._masses, BLOCK=block, num_warps=warps(block),
        )  # fmt: skip
        return squares

    def _move_tiles(self, start: TritonStart, output: Tensor, budget: Tensor | None) -> Tensor:
        """`_move` within an energy, for scenes of any size; (B, m tiles) squares of the longest steps."""
        model, (batch, frames, count, _) = self.emulator, start.path[:, 1:].shape
        tiles = blocks(count)
        sums = start.path.new_empty(batch, frames, tiles, motion.SUMS.value)
        squares = start.path.new_empty(batch, frames * tiles)
        weight, carried = self._weight(start), torch.empty_like(start.velocity)
        numbers, options = self._moving(output)
        for frame in range(frames + 1):
            motion.advance[tiles, batch](
                start.velocity, start.material, weight, start.gravity, start.state, output, model.output_scale, budget,
                model.bounds, carried, start.path, sums, squares, frame, frames, count, tiles, *numbers, **options,
                FIRST=frame == 0, LAST=frame == frames, BLOCK=launch.BLOCK, TILES=power(tiles),
            )  # fmt: skip
        return squares

    def _hold(self, start: TritonStart, squares: Tensor) -> None:
        path, (tiles, batch) = start.path, programs(start.velocity)
        frames, count, entries = path.shape[1] - 1, path.shape[2], squares.shape[1]
        free = torch.empty_like(start.material, dtype=torch.int32)
        way, lengths = path.new_empty(batch, 2, count, 2), path.new_empty(batch, tiles)
        options: dict[str, Any] = {"SURFACE": SURFACE, "BLOCK": launch.BLOCK, "STEPS": power(entries)} | self._axes
        contact.touch[tiles, batch](
            path, start.volume, start.share, squares, free, way, lengths, frames, count, tiles, entries, **options
        )
        contact.hold[tiles, batch](
            path, start.share, squares, free, way, lengths, frames, count, tiles, entries, *self._limits, **options,
            TILES=power(tiles),
        )  # fmt: skip

    def _rest(self, start: TritonStart) -> None:
        params, path, longest = self.parameters, start.path, max(self.parameters.shape)
        held = path.new_empty(len(path), params.size, dtype=torch.int8)
        (left, right), (down, up) = params.floors.tolist()
        options: dict[str, Any] = {"OBSTACLES": params.obstacles, "SURFACE": SURFACE} | self._axes
        rest.support[-(-longest // _COLUMNS), len(path)](
            start.state, start.share, start.gravity, held, params.channels, **options, MATERIALS=len(params.mass),
            LEFT=left, RIGHT=right, DOWN=down, UP=up, REACH=REACH, ENOUGH=ENOUGH, ROWS=power(longest), COLUMNS=_COLUMNS,
        )  # fmt: skip
        rest.rest[programs(start.velocity)](
            path, start.gravity, start.share, held, path.shape[1] - 1, path.shape[2], *self._limits, params.rest_speed,
            **options, FREE_FALL=FREE_FALL_SHARE, DROP=MAX_DROP, BLOCK=launch.BLOCK,
        )  # fmt: skip

    def _flow(self, start: TritonStart, context: RolloutContext) -> Tensor:
        """(B, *S, 2) displacements at the nodes that spread overfull cells at the path's end."""
        params, path, block = self.parameters, start.path, whole(self.parameters.size)
        counts, flow = path.new_empty(3, len(path), params.size), path.new_empty(len(path), *params.shape, 2)
        crowding.press[len(path),](
            path, start.volume, *self._taken(context), counts[0], counts[1:], flow, *self._crowd, path.shape[2],
            path.shape[1] - 1, **self._axes, CLOSED=CLOSED, SWEEPS=SWEEPS, PARTICLES=launch.BLOCK, BLOCK=block,
            num_warps=warps(block),
        )  # fmt: skip
        return flow

    def _flow_tiles(self, start: TritonStart, context: RolloutContext) -> Tensor:
        """`_flow` for grids of any size."""
        params, path, (taken, per_scene) = self.parameters, start.path, self._taken(context)
        counts, over_nodes = path.new_zeros(len(path), *params.shape), (blocks(params.size), len(path))
        crowding.count_ends[programs(start.velocity)](
            path, start.volume, counts, path.shape[2], path.shape[1] - 1, **self._axes, BLOCK=launch.BLOCK
        )
        before, after = torch.empty_like(counts), torch.empty_like(counts)
        for sweep in range(SWEEPS):
            before, after = after, before
            crowding.relax[over_nodes](
                counts, taken, per_scene, before, after, *self._crowd, **self._axes, CLOSED=CLOSED, FIRST=sweep == 0,
                BLOCK=launch.BLOCK,
            )  # fmt: skip
        flow = path.new_empty(len(path), *params.shape, 2)
        crowding.find_flow[over_nodes](taken, per_scene, after, flow, self._crowd[1], **self._axes, BLOCK=launch.BLOCK)
        return flow

    @property
    def _crowd(self) -> tuple[float, float]:
        """A particle's share of a full cell, and the conductance across the second axis."""
        return self.parameters.particle_volume / self.parameters.density_cap, 1 / float(self.parameters.ratio[1]) ** 2

    @property
    def _spreading(self) -> tuple[tuple[float, ...], dict[str, Any]]:
        """What kernels that spread paths are told."""
        contact_acts = self.parameters.obstacles and self.parameters.solids
        options = {"CONTACT": contact_acts, "SURFACE": SURFACE, "SHIFT": MAX_SHIFT} | self._axes
        return (*self._limits, float(self.parameters.ratio[1])), options

    def _spread(self, start: TritonStart, flow: Tensor, budget: Tensor | None) -> Tensor:
        """(B, m + 1, N, 2) the path that spreads its overfull cells; its first frame is not filled."""
        spreads, (_, frames, count, _) = torch.empty_like(start.path), start.path.shape
        numbers, options = self._spreading
        crowding.spread_scene[1, len(flow)](
            start.path, start.volume, start.material, start.gravity, start.share, flow,
            flow if budget is None else budget, spreads, frames - 1, count, *numbers, **options,
            LIMITED=budget is not None, MASSES=self._masses, BLOCK=whole(count), num_warps=warps(whole(count)),
        )  # fmt: skip
        return spreads

    def _spread_tiles(self, start: TritonStart, flow: Tensor, budget: Tensor | None) -> Tensor:
        """`_spread` for scenes of any size."""
        path, (tiles, batch), (numbers, options) = start.path, programs(start.velocity), self._spreading
        spreads, frames, count = torch.empty_like(path), path.shape[1] - 1, path.shape[2]
        energies = path.new_empty(batch, frames + 1, tiles, 2)
        crowding.spread[tiles, batch](
            path, self._weight(start), start.gravity, start.share, flow, spreads, energies, frames, count, tiles,
            *numbers, **options, BLOCK=launch.BLOCK,
        )  # fmt: skip
        if budget is not None:
            crowding.take_back[tiles, batch](
                path, spreads, energies, budget, frames, count, tiles, BLOCK=launch.BLOCK, TILES=power(tiles)
            )
        return spreads
