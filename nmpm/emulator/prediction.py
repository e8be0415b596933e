"""One call of an emulator: particles to the grid, network, and back through a bundle of frames.

Around the network there are two implementations: tensor operations, for every device and with gradients, and the
kernels of `nmpm.emulator.fused`. `steps_for` chooses. Only the network is computed by the emulator's runtime.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nmpm._support.collectives import normal_like
from nmpm.emulator.advection import Advection
from nmpm.emulator.bundle import Bundle, BundleStart, RolloutContext
from nmpm.emulator.fused.arrays import ArrayCache
from nmpm.emulator.fused.parameters import KernelParameters
from nmpm.emulator.rasterise import grid_state
from nmpm.particles import Particles, scene_volumes
from nmpm.transfer.execution import kernels_take

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator


@dataclass(frozen=True)
class Steps(ABC):
    """How an emulator's calls are computed."""

    emulator: Emulator

    def prepare_rollout(self, solid: Tensor, budget: Tensor | None) -> RolloutContext:
        """The context of a rollout; arguments as there."""
        return RolloutContext(solid, budget)

    @abstractmethod
    def predict(self, particles: Particles, context: RolloutContext) -> Bundle:
        """The next m frames, from these steps and the emulator's network."""


class TensorSteps(Steps):
    """The steps as tensor operations; subclasses replace some of them."""

    def predict(self, particles: Particles, context: RolloutContext) -> Bundle:
        emulator, device = self.emulator, particles.position.device.type
        with _full_precision(device):
            cells, velocity, gravity, state = self.rasterise(particles, context.solid)
            normalised = emulator.normalise(state)
            if emulator.training and emulator.recipe.grid_noise > 0:
                normalised = normalised + emulator.recipe.grid_noise * normal_like(normalised)
        output = emulator.runtime.fields(emulator.processor, normalised, emulator.network_precision)
        with _full_precision(device):
            velocities = len(emulator.scene.materials) * emulator.scene.dim  # channels; then rates of fields
            predicted, scale = output[:, :, :velocities], emulator.output_scale[:, :velocities]
            start = BundleStart(
                cells, velocity, gravity, particles.material, particles.present_volume, particles.mask, state,
                predicted, scale, self._solids_ahead(particles),
            )  # fmt: skip
            path = self.path(start, context)
            fields: Mapping[str, Tensor] = {}
            if emulator.scene.evolving:
                rates = output[:, :, velocities:].to(emulator.precision) * emulator.output_scale[:, velocities:]
                before = torch.cat([cells.unsqueeze(1), path[:, :-1]], dim=1)
                gather = partial(Advection(emulator).gather, material=particles.material)
                fields = emulator.field_scales.evolve(particles, before, rates, gather)
            step = path[:, -1] - (path[:, -2] if emulator.frames > 1 else cells)
            if emulator.constraints.density_cap and not emulator.training:
                # Spreading is no motion of the material: the velocity is that of the path without it.
                path = self.uncrowded(start, path, context)
            precision = particles.position.dtype
            last_velocity = emulator.grid.to_displacement(step.to(precision))
            return Bundle(emulator.grid.to_length(path.to(precision)), last_velocity, fields)

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

    def rasterise(self, particles: Particles, solid: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Positions (B, N, D), velocities (B, N, D) and gravity (B, 1, D) in cells; grid state (B, C_in, *S)."""
        model = self.emulator
        cells, velocity, gravity = model.in_cells(particles)
        state = grid_state(
            model.scene, model.grid, model.transfer, particles, cells, velocity, solid, model.field_scales
        )
        return cells, velocity, gravity, state

    def path(self, start: BundleStart, context: RolloutContext) -> Tensor:
        """(B, m, N, D) positions in cells, which obey the emulator's constraints."""
        advection = Advection(self.emulator)
        if self.emulator.training:
            return advection.free_path(start)
        return advection.constrained_path(start, context.solid, context.budget)

    def uncrowded(self, start: BundleStart, path: Tensor, context: RolloutContext) -> Tensor:
        """The path (B, m, N, D) with its overfull cells spread, see `Advection.uncrowded_path`."""
        return Advection(self.emulator).uncrowded_path(start, path, context.solid, context.budget)


def _full_precision(device: str) -> AbstractContextManager[object]:
    """A context without autocast; entering one where none is on would cost as much as a small operation."""
    on = torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)
    return torch.autocast(device, enabled=False) if on else nullcontext()


@dataclass(frozen=True)
class FusedSteps(Steps):
    """All steps as kernels; only for what `steps_for` gives them to."""

    parameters: KernelParameters

    def prepare_rollout(self, solid: Tensor, budget: Tensor | None) -> RolloutContext:
        from nmpm.emulator.fused.solids import prepare_solids  # imported late, as Numba is

        return RolloutContext(solid, budget, prepare_solids(self.parameters, solid, self.emulator.walls), ArrayCache())

    def predict(self, particles: Particles, context: RolloutContext) -> Bundle:
        from nmpm.emulator.fused.call import predict

        return predict(self.emulator, self.parameters, particles, context)


@dataclass(frozen=True)
class TrainingSteps(TensorSteps):
    """The steps of trainings as kernels with gradients; only for what `steps_for` gives them to."""

    parameters: KernelParameters

    def rasterise(self, particles: Particles, solid: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        from nmpm.emulator.fused.autograd import Rasterise

        given = (particles.position, particles.velocity, particles.gravity, particles.material, particles.mask)
        cells, velocity, gravity, state = Rasterise.apply(self.parameters, *given, solid)  # type: ignore[no-untyped-call]
        if (volume := particles.volume) is not None and (of_scene := scene_volumes(volume, particles.mask)) is not None:
            factor, (first, end) = state.new_ones(state.shape[:2]), self.parameters.volume_channels
            factor[:, first:end] = of_scene.unsqueeze(1)
            state = state * factor.reshape(*factor.shape, *(1,) * (state.dim() - 2))
        return cells, velocity, gravity, state

    def path(self, start: BundleStart, context: RolloutContext) -> Tensor:  # noqa: ARG002 (no constraint acts)
        from nmpm.emulator.fused.autograd import FreePath

        path: Tensor = FreePath.apply(  # type: ignore[no-untyped-call]  # (torch's stubs)
            self.parameters, start.cells, start.velocity, start.gravity, start.material, start.mask, start.state,
            start.output, start.scale,
        )  # fmt: skip
        return path


def steps_for(emulator: Emulator, particles: Particles, solid: Tensor) -> Steps:
    """The kernels where they can do what is asked for, else tensor operations.

    Kernels run on a CPU, in float32, for the parts of this package (`kernel_parameters`) and obstacles at rest, outside
    of `without_kernels`. In training mode those with gradients, if neither obstacles nor gravity need any and the
    particles of each scene are of one size; in evaluation mode those without, if all particles are of the scene's size.
    Graphs that `torch.compile` traces take tensor operations.
    """
    motion, fixed = (particles.position, particles.velocity), (particles.gravity, solid)
    parameters, is_float32 = emulator.kernel_parameters, emulator.precision == torch.float32
    if parameters is None or not is_float32 or not kernels_take(*motion, particles.gravity):
        return TensorSteps(emulator)
    if particles.obstacle_velocity is not None:
        return TensorSteps(emulator)
    if torch.compiler.is_compiling() or _need_gradients(fixed):
        return TensorSteps(emulator)
    if emulator.training:
        takes = parameters.trains and scene_volumes(particles.volume, particles.mask) is not None
        return TrainingSteps(emulator, parameters) if takes else TensorSteps(emulator)
    if particles.volume is not None:
        return TensorSteps(emulator)
    if _need_gradients(motion) or _need_gradients(emulator.parameters()):
        return TensorSteps(emulator)
    return FusedSteps(emulator, parameters)


def _need_gradients(tensors: Iterable[Tensor]) -> bool:
    return torch.is_grad_enabled() and any(values.requires_grad for values in tensors)
