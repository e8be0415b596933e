"""The engine of tensor operations."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from nmpm._support.collectives import normal_like
from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.engines.engine import Engine, Flight
from nmpm.emulator.engines.torch.advection import Advection, BundleStart
from nmpm.emulator.rasterise import grid_state
from nmpm.particles import Particles


class TorchEngine(Engine[BundleStart, Tensor]):
    """The reference. Other engines with tensors replace some of its steps."""

    name = "torch"

    def rasterise(self, particles: Particles, context: RolloutContext) -> BundleStart:
        cells, velocity, gravity, state = self.grid_state(particles, context.solid)
        return BundleStart(particles, cells, velocity, gravity, state, self.solids_ahead(particles))

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
        flows, fields = output, dict[str, Tensor]()
        if emulator.scene.evolving:
            flows, rates = output.split([velocities, output.shape[2] - velocities], dim=2)
        path = self.path(start, flows, context)
        if emulator.scene.evolving:
            gains = self.gains(start, path, rates.to(emulator.precision) * emulator.output_scale[:, velocities:])
            fields = emulator.field_scales.evolve(start.particles.fields, gains)
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

    def gains(self, start: BundleStart, path: Tensor, rates: Tensor) -> Tensor:
        """(B, m, N, E) sums of the rates (B, m, materials * E, *S) that particles meet before each frame's step."""
        gather, before = Advection(self.emulator).gather, (start.cells, *path[:, :-1].unbind(1))
        steps = [gather(rate, cells, start.material) for rate, cells in zip(rates.unbind(1), before, strict=True)]
        return torch.stack(steps, dim=1).cumsum(1)

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
