"""The steps around the network with gradients, for trainings on a CUDA GPU: p2g, and the free way through a bundle.

They are for linear transfers and bounds that stop particles, in 2-D. Sums are in no fixed order. Second derivatives are
an error. Where the grid and the bounds are is read on the device, so that steps can be recorded while the grid moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.library import triton_op, wrap_triton

from nmpm.emulator.bundle import RolloutContext
from nmpm.emulator.engines.torch.advection import BundleStart
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.particles import Particles
from nmpm_triton import launch
from nmpm_triton.adjoint import flight_back, rasterise_back
from nmpm_triton.grid import fill_state, scatter
from nmpm_triton.launch import axes, blocks, decoding, programs, walls
from nmpm_triton.motion import flight


class TritonTraining(TorchEngine):
    """The torch engine with kernels for p2g and the path, both with gradients, for trainings on a CUDA GPU."""

    name = "triton training"

    def grid_state(self, particles: Particles, solid: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        cells, velocity, gravity = self.emulator.in_cells(particles)
        params, walls_of_scene = self.parameters, self.emulator.walls
        state = rasterise(
            cells, velocity, gravity, particles.material, particles.present_volume, solid, walls_of_scene,
            params.particle_volume, len(params.mass), params.constants, params.wraps,
        )  # fmt: skip
        return cells, velocity, gravity, state.movedim(-1, 1)

    def path(self, start: BundleStart, output: Tensor, context: RolloutContext) -> Tensor:  # noqa: ARG002 (no constraint acts)
        params, model = self.parameters, self.emulator
        path: Tensor = free_path(
            start.cells, start.velocity, start.gravity, start.material, start.mask, start.state.movedim(1, -1), output,
            model.output_scale, model.bounds, params.wraps, model.scene.confined, [float(x) for x in params.decoder],
        )  # fmt: skip
        return path


@triton_op("nmpm::triton_rasterise", mutates_args=())
def rasterise(
    cells: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor, volume: Tensor, solid: Tensor, walls: Tensor,
    particle: float, materials: int, constants: bool, wraps: Sequence[bool],
) -> Tensor:  # fmt: skip
    """The grid state (B, *S, C) of particles with positions (B, N, 2), velocities (B, N, 2) and gravity in cells."""
    shape, (batch, count, _), solids = solid.shape[2:], cells.shape, solid.shape[1]
    cells, velocity, solid = cells.contiguous(), velocity.contiguous(), solid.contiguous()
    gravity, grid = gravity.contiguous(), axes(shape, wraps)
    sums = cells.new_zeros(batch, *shape, 3 * materials)
    wrap_triton(scatter)[programs(cells)](
        cells, velocity, gravity, material.contiguous(), volume.contiguous(), cells, velocity, gravity, sums, count,
        count, 0.0, 0.0, 1.0, 1.0, **grid, MATERIALS=materials, CONVERT=False, BLOCK=launch.BLOCK,
    )  # fmt: skip
    size, channels = shape[0] * shape[1], 3 * materials + solids + 2 * constants
    state = cells.new_empty(batch, *shape, channels)
    wrap_triton(fill_state)[blocks(size), batch](
        sums, solid, size, walls, gravity, walls, walls, walls, walls, state, state, state, particle, channels, size,
        MATERIALS=materials, SOLID=solids, CONSTANTS=constants, OBSTACLES=False, SEEN=False, BLOCK=launch.BLOCK,
    )  # fmt: skip
    return state


@triton_op("nmpm::triton_rasterise_back", mutates_args=())
def gradients_of_rasterise(
    cells: Tensor, velocity: Tensor, material: Tensor, volume: Tensor, state: Tensor, grad: Tensor, particle: float,
    materials: int, wraps: Sequence[bool],
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Gradients with respect to positions and velocities, from those with respect to the grid state."""
    cells, velocity = cells.contiguous(), velocity.contiguous()
    grad_cells, grad_velocity = torch.empty_like(cells), torch.empty_like(velocity)
    wrap_triton(rasterise_back)[programs(cells)](
        cells, velocity, material.contiguous(), volume.contiguous(), state, grad.contiguous(), grad_cells,
        grad_velocity, cells.shape[1], state.shape[-1], particle, **axes(state.shape[1:3], wraps),
        MATERIALS=materials, BLOCK=launch.BLOCK,
    )  # fmt: skip
    return grad_cells, grad_velocity


@triton_op("nmpm::triton_free_path", mutates_args=())
def free_path(
    cells: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor, mask: Tensor, state: Tensor, output: Tensor,
    scale: Tensor, bounds: Tensor, wraps: Sequence[bool], confined: Sequence[bool], decoder: Sequence[float],
) -> Tensor:  # fmt: skip
    """(B, m, N, 2) positions by a network's output (B, m, 2 M, *S), from a grid state (B, *S, C), within the bounds."""
    (batch, count, _), frames, outputs = cells.shape, output.shape[1], output.shape[2]
    cells, state, scale = cells.contiguous(), state.contiguous(), scale.contiguous()
    path, tiles = cells.new_empty(batch, frames, count, 2), blocks(count)
    squares = cells.new_empty(batch, tiles)
    wrap_triton(flight)[tiles, batch](
        cells, velocity.contiguous(), material.contiguous(), mask.contiguous(), gravity.contiguous(), state, output,
        scale, squares, bounds, path, squares, frames, count, count, frames * count, state.shape[-1], outputs,
        *output.stride(), *bounds.stride(), 1.0, **axes(state.shape[1:3], wraps), **walls(confined),
        **decoding(decoder), MATERIALS=outputs // 2, LIMITED=False, MASSES=(1.0,), BLOCK=launch.BLOCK,
    )  # fmt: skip
    return path


@triton_op("nmpm::triton_free_path_back", mutates_args=())
def gradients_of_free_path(
    cells: Tensor, material: Tensor, mask: Tensor, state: Tensor, output: Tensor, scale: Tensor, bounds: Tensor,
    path: Tensor, grad: Tensor, wraps: Sequence[bool], confined: Sequence[bool], decoder: Sequence[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients with respect to positions, velocities, grid state and output, from those with respect to the path."""
    (batch, count, _), (frames, outputs, *shape) = cells.shape, output.shape[1:]
    cells, state, scale = cells.contiguous(), state.contiguous(), scale.contiguous()
    grad_cells, grad_velocity = torch.empty_like(cells), torch.empty_like(cells)
    grad_state, grad_output = torch.zeros_like(state), state.new_zeros(batch, frames, *shape, outputs)
    options = decoding(decoder) | axes(state.shape[1:3], wraps) | walls(confined)
    del options["FALL"]
    wrap_triton(flight_back)[programs(cells)](
        cells, material.contiguous(), mask.contiguous(), state, output, scale, bounds, path, grad.contiguous(),
        grad_cells, grad_velocity, grad_state, grad_output, frames, count, state.shape[-1], outputs, *output.stride(),
        *bounds.stride(), **options, MATERIALS=outputs // 2, BLOCK=launch.BLOCK,
    )  # fmt: skip
    return grad_cells, grad_velocity, grad_state, grad_output.movedim(-1, 2).to(output.dtype)


def _keep_for_rasterise(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    cells, velocity, _, material, volume, _, _, particle, materials, _, wraps = inputs
    ctx.save_for_backward(cells, velocity, material, volume, output)
    ctx.numbers = particle, materials, wraps


def _rasterise_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    return *gradients_of_rasterise(*ctx.saved_tensors, grad, *ctx.numbers), *(None,) * 9


def _keep_for_free_path(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    cells, _, _, *tensors, wraps, confined, decoder = inputs
    ctx.save_for_backward(cells, *tensors, output)
    ctx.numbers = wraps, confined, decoder


def _free_path_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    gradients = gradients_of_free_path(*ctx.saved_tensors, grad, *ctx.numbers)
    return *gradients[:2], None, None, None, *gradients[2:], *(None,) * 5


rasterise.register_autograd(_rasterise_backward, setup_context=_keep_for_rasterise)
free_path.register_autograd(_free_path_backward, setup_context=_keep_for_free_path)
