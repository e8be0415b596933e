"""The steps around the network with gradients, for trainings on a CPU: p2g, and the free way through a bundle.

They are for linear transfers and bounds that stop particles, in 2-D (`KernelParameters.trains`). Each scene of a batch
is a thread's work, so that results do not depend on the number of threads. Second derivatives are an error. Torch's
operators with gradients (`torch.library.register_autograd`) take 0.2 ms a call more than these functions, as long as
the kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nmpm._support.jit import jit
from nmpm._support.threads import for_each
from nmpm.emulator.bundle import RolloutContext
from nmpm.emulator.engines.numba.arrays import as_array, as_copy, as_grid, check_materials, material_rows
from nmpm.emulator.engines.numba.gather import gather_adjoint
from nmpm.emulator.engines.numba.parameters import Array, KernelParameters
from nmpm.emulator.engines.numba.path import find_path
from nmpm.emulator.engines.numba.scatter import scatter_adjoint
from nmpm.emulator.engines.numba.state import StartArrays, output_array, rasterise, unpack
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.emulator.engines.torch.start import BundleStart
from nmpm.particles import Particles, scene_volumes

ZERO, ONE = np.float32(0), np.float32(1)


@dataclass(frozen=True)
class NumbaTraining(TorchEngine):
    """The torch engine with kernels for p2g and the path, both with gradients, for trainings on a CPU."""

    parameters: KernelParameters
    name = "numba training"

    def grid_state(self, particles: Particles, solid: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        given = (particles.position, particles.velocity, particles.gravity, particles.material, particles.mask)
        cells, velocity, gravity, state = Rasterise.apply(self.parameters, *given, solid)  # type: ignore[no-untyped-call]
        if (volume := particles.volume) is not None and (of_scene := scene_volumes(volume, particles.mask)) is not None:
            factor, (first, end) = state.new_ones(state.shape[:2]), self.parameters.volume_channels
            factor[:, first:end] = of_scene.unsqueeze(1)
            state = state * factor.reshape(*factor.shape, *(1,) * (state.dim() - 2))
        return cells, velocity, gravity, state

    def path(self, start: BundleStart, output: Tensor, context: RolloutContext) -> Tensor:  # noqa: ARG002 (no constraint acts)
        path: Tensor = FreePath.apply(  # type: ignore[no-untyped-call]  # (torch's stubs)
            self.parameters, start.cells, start.velocity, start.gravity, start.material, start.mask, start.state,
            output, self.emulator.output_scale,
        )  # fmt: skip
        return path


class Rasterise(torch.autograd.Function):
    """Particles in grid units and the grid state, with gradients with respect to positions and velocities."""

    @staticmethod
    def forward(
        ctx: Any, parameters: KernelParameters, position: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor,
        mask: Tensor, solid: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        """(B, N, D) positions, (B, N, D) velocities and (B, 1, D) gravity in cells; (B, C_in, *S) grid state."""
        kinds = material_rows(material, len(parameters.mass))
        start = rasterise(
            parameters, as_array(position), as_array(velocity), as_array(gravity), kinds, as_array(mask),
            as_array(solid),
        )  # fmt: skip
        cells, moved, pull = torch.from_numpy(start.cells), torch.from_numpy(start.velocity), start.gravity[:, None]
        state, pulls = as_grid(start.state, parameters.shape), torch.from_numpy(pull)
        ctx.parameters = parameters
        ctx.save_for_backward(cells, moved, state, material, mask)
        ctx.mark_non_differentiable(pulls)
        return cells, moved, pulls, state

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients with respect to positions and velocities, from those with respect to cells, moved and state."""
        parameters: KernelParameters = ctx.parameters
        cells, moved, state, material, mask = ctx.saved_tensors
        grad_cells, grad_moved, channels = as_copy(grads[0]), as_copy(grads[1]), parameters.volume_channels[1]
        grad_state = as_copy(grads[3][:, :channels].movedim(1, -1)).reshape(len(cells), -1, channels)
        rows = as_array(state.movedim(1, -1)).reshape(*grad_state.shape[:2], -1)
        inputs = as_array(moved), material_rows(material, len(parameters.mass)), as_array(mask), as_array(cells)
        volume = np.float32(parameters.particle_volume)

        def follow(b: int) -> None:
            speeds, kind, real, here = (values[b] for values in inputs)
            rasterise_back(
                speeds, kind, real, here, parameters.grid, rows[b], volume, parameters.box, grad_state[b],
                grad_cells[b], grad_moved[b],
            )  # fmt: skip

        for_each(follow, len(cells), torch.get_num_threads())
        return None, torch.from_numpy(grad_cells), torch.from_numpy(grad_moved), *(None,) * 4


class FreePath(torch.autograd.Function):
    """The free path with gradients with respect to positions, velocities, grid state and network output."""

    @staticmethod
    def forward(ctx: Any, parameters: KernelParameters, *tensors: Tensor) -> Tensor:
        """(B, m, N, D) positions in cells; tensors as of `BundleStart`, and the network's output and scale."""
        start, fields = _to_arrays(parameters, *tensors)
        check_materials(parameters, start.material)
        path = np.empty((len(fields), fields.shape[1], *start.cells.shape[1:]), np.float32)

        def move(b: int) -> None:
            find_path(start.scene(b), fields[b], parameters, None, path[b], 1)

        for_each(move, len(path), torch.get_num_threads())
        positions = torch.from_numpy(path)
        ctx.parameters = parameters
        ctx.save_for_backward(*tensors, positions)
        return positions

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients with respect to cells, velocity, state and output."""
        parameters: KernelParameters = ctx.parameters
        *tensors, positions = ctx.saved_tensors
        output, scale = tensors[-2:]
        (start, fields), path = _to_arrays(parameters, *tensors), as_array(positions)
        grad_cells, grad_velocity = np.zeros((2, *start.cells.shape), np.float32)
        grad_state, grad_fields = np.zeros_like(start.state), np.zeros_like(fields)

        def follow(b: int) -> None:
            cells, _, _, material, mask, state = start.scene(b)
            path_back(
                cells, material, mask, parameters.grid, state, fields[b], parameters.decoder, parameters.bounds,
                path[b], as_copy(grad[b]), grad_cells[b], grad_velocity[b], grad_state[b], grad_fields[b],
            )  # fmt: skip

        for_each(follow, len(path), torch.get_num_threads())
        to_output = torch.from_numpy(grad_fields).movedim(-1, 2).unflatten(3, parameters.shape)
        back = torch.from_numpy(grad_cells), torch.from_numpy(grad_velocity), None, None, None
        return None, *back, as_grid(grad_state, parameters.shape), (to_output * scale).to(output.dtype), None


def _to_arrays(
    parameters: KernelParameters, cells: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor, mask: Tensor,
    state: Tensor, output: Tensor, scale: Tensor,
) -> tuple[StartArrays, Array]:  # fmt: skip
    """The start, and the fields (B, m, size, C) of an output; tensors as of `FreePath.forward`."""
    rows = as_array(state.movedim(1, -1)).reshape(len(cells), -1, state.shape[1])
    kinds, pull = material_rows(material, len(parameters.mass)), as_array(gravity)[:, 0]
    fields = np.empty((*output.shape[:2], rows.shape[1], output.shape[2]), np.float32)
    predicted, factors = output_array(output), as_array(scale).reshape(-1)
    for_each(lambda b: unpack(predicted[b], factors, fields[b]), len(fields), torch.get_num_threads())
    return StartArrays(as_array(cells), as_array(velocity), pull, kinds, as_array(mask), rows), fields


@jit
def path_back(
    cells: Any, material: Any, mask: Any, grid: Any, state: Any, fields: Any, decoder: Any, bounds: Any, path: Any,
    grad_path: Any, grad_cells: Any, grad_velocity: Any, grad_state: Any, grad_fields: Any,
) -> Any:  # fmt: skip
    """Add the gradients of what `find_path` starts from; a position stopped at a bound, or of padding, passes none.

    `grad_path` is overwritten; `grad_velocity` must hold zeros; the others are added to.
    """
    carries = decoder[3] > ZERO
    for frame in range(len(path) - 1, -1, -1):
        grad = grad_path[frame]
        here, target = (path[frame - 1], grad_path[frame - 1]) if frame > 0 else (cells, grad_cells)
        if carries and frame > 0:  # the velocity of the frame before is a difference of positions
            _step_back(path[frame], mask, bounds, grad, target, target)
            earlier = grad_path[frame - 2] if frame > 1 else grad_cells
            earlier -= grad
        else:
            _step_back(path[frame], mask, bounds, grad, target, grad_velocity)
        gather_adjoint(fields[frame], material, mask, here, grid[0], grid[1], grad, target, grad_fields[frame])
    if decoder[1] != ZERO:
        smoothed = decoder[1] * grad_velocity
        gather_adjoint(state, material, mask, cells, grid[0], grid[1], smoothed, grad_cells, grad_state)
    grad_velocity *= decoder[0]


@jit
def _step_back(cells: Any, mask: Any, bounds: Any, grad: Any, grad_before: Any, grad_step: Any) -> Any:
    """Add the gradient of positions x + v to those of x and of v; set it to 0 for padding and at bounds before."""
    for d in range(cells.shape[1]):
        lowest, highest = bounds[0, d], bounds[1, d]
        for p in range(len(cells)):
            x = cells[p, d]
            passed = grad[p, d] if mask[p] and x > lowest and x < highest else ZERO
            grad[p, d] = passed
            grad_before[p, d] += passed
            grad_step[p, d] += passed


@jit
def rasterise_back(
    moved: Any, material: Any, mask: Any, cells: Any, grid: Any, state: Any, particle_volume: Any, box: Any,
    grad_state: Any, grad_cells: Any, grad_moved: Any,
) -> Any:  # fmt: skip
    """Turn gradients with respect to cells and velocities in cells into those in domain length, the state's added.

    `moved` are the velocities (N, D) in cells, `grad_state` (size, M D + M) is of the state's first channels; all three
    gradients are changed.
    """
    width = moved.shape[1]
    materials = grad_state.shape[1] // (width + 1)
    for node in range(len(grad_state)):
        for kind in range(materials):
            volume = materials * width + kind
            count = state[node, volume] / particle_volume
            for k in range(kind * width, (kind + 1) * width):
                grad_state[node, k] /= count if count > ZERO else ONE
            grad_state[node, volume] *= particle_volume
    scatter_adjoint(moved, material, mask, cells, grid[0], grid[1], state, grad_state, grad_cells, grad_moved)
    for p in range(len(grad_cells)):
        for d in range(width):
            grad_cells[p, d] /= box[1, d]
            grad_moved[p, d] /= box[1, d]
