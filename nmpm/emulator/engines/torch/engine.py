"""The engine of tensor operations."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor

from nmpm._support.collectives import normal_like
from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.engines.engine import Engine, Flight
from nmpm.emulator.engines.torch.advection import Advection
from nmpm.emulator.engines.torch.start import BundleStart
from nmpm.emulator.rasterise import grid_state
from nmpm.particles import Particles


class TorchEngine(Engine[BundleStart, Tensor]):
    """The reference. Other engines with tensors replace some of its steps."""

    name = "torch"

    def rasterise(self, particles: Particles, context: RolloutContext) -> BundleStart:
        cells, velocity, gravity, state = self.grid_state(particles, context.solid)
        return BundleStart(particles, cells, velocity, gravity, state, self._solids_ahead(particles))

    def grid_state(self, particles: Particles, solid: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Positions (B, N, D), velocities (B, N, D) and gravity (B, 1, D) in cells; grid state (B, C_in, *S)."""
        model = self.emulator
        cells, velocity, gravity = model.in_cells(particles)
        state = grid_state(
            model.scene, model.grid, model.transfer, particles, cells, velocity, solid, model.field_scales
        )
        return cells, velocity, gravity, state

    def normalise(self, start: BundleStart, context: RolloutContext) -> Tensor:  # noqa: ARG002 (other engines')
        emulator = self.emulator
        normalised = emulator.normalise(start.state)
        if emulator.training and emulator.recipe.grid_noise > 0:
            normalised = normalised + emulator.recipe.grid_noise * normal_like(normalised)
        return normalised

    def fly(self, start: BundleStart, output: Tensor, context: RolloutContext) -> Flight[Tensor]:
        emulator, velocities = self.emulator, self.emulator.scene.dim * len(self.emulator.scene.materials)
        path = self.path(start, output[:, :, :velocities], context)  # the other channels are rates of fields
        fields: Mapping[str, Tensor] = {}
        if emulator.scene.evolving:
            rates = output[:, :, velocities:].to(emulator.precision) * emulator.output_scale[:, velocities:]
            before = torch.cat([start.cells.unsqueeze(1), path[:, :-1]], dim=1)
            gather = partial(Advection(emulator).gather, material=start.material)
            fields = emulator.field_scales.evolve(start.particles, before, rates, gather)
        return Flight(path, path[:, -1] - (path[:, -2] if emulator.frames > 1 else start.cells), fields)

    def path(self, start: BundleStart, output: Tensor, context: RolloutContext) -> Tensor:
        """(B, m, N, D) positions in cells by an output (B, m, materials * D, *S), which obey the constraints."""
        fields, advection = self.velocities(output), Advection(self.emulator)
        if self.emulator.training:
            path = advection.free_path(start, fields)
        else:
            path = advection.constrained_path(start, fields, context.solid, context.budget)
        advection.check_bounds(start, path)
        return path

    def velocities(self, output: Tensor) -> Tensor:
        """(B, m, materials * D, *S) in cells per frame."""
        return output.to(self.emulator.precision) * self.emulator.output_scale[:, : output.shape[2]]

    def spread(self, start: BundleStart, flight: Flight[Tensor], context: RolloutContext) -> Flight[Tensor]:
        path = Advection(self.emulator).spread_path(start, flight.path, context.solid, context.budget)
        return dataclasses.replace(flight, path=path)

    def land(self, start: BundleStart, flight: Flight[Tensor]) -> Bundle:
        grid, precision = self.emulator.grid, start.particles.position.dtype
        position, velocity = grid.to_length(flight.path.to(precision)), grid.to_displacement(flight.step.to(precision))
        return Bundle(position, velocity, flight.fields)

    def _solids_ahead(self, particles: Particles) -> Tensor | None:
        """(B, m, *S) solid fraction at each frame, of obstacles that keep their velocity; None where none moves."""
        model, velocity = self.emulator, particles.obstacle_velocity
        if velocity is None or model.training or not (model.scene.obstacles and model.constraints.solids):
            return None
        at_frames = (
            dataclasses.replace(particles, obstacle=particles.obstacle + frame * velocity)
            for frame in range(1, model.frames + 1)
        )
        return torch.cat([model.solid(there) for there in at_frames], dim=1)
