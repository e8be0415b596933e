"""The steps around the network with gradients, for trainings on a CPU: p2g, and the free way through a bundle.

They are for linear transfers and bounds that stop particles, in 2-D. Each scene of a batch is a thread's work, so that
results do not depend on the number of threads. Second derivatives are an error. Torch's operators with gradients
(`torch.library.register_autograd`) take 0.2 ms a call more than these functions, as long as the kernels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nmpm._support.jit import jit
from nmpm._support.threads import for_each
from nmpm.emulator.bundle import RolloutContext
from nmpm.emulator.engines.numba.arrays import as_array, as_copy, as_grid, check_materials, material_rows
from nmpm.emulator.engines.numba.gather import gather, gather_adjoint
from nmpm.emulator.engines.numba.parameters import Array, KernelParameters
from nmpm.emulator.engines.numba.path import find_path
from nmpm.emulator.engines.numba.scatter import scatter_adjoint
from nmpm.emulator.engines.numba.state import ParticleArrays, StartArrays, output_array, rasterise, unpack
from nmpm.emulator.engines.torch.advection import BundleStart
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.emulator.rasterise import solid_channels
from nmpm.particles import Particles, scene_volumes
from nmpm.transfer import LEAST_SHARE

ZERO, ONE = np.float32(0), np.float32(1)


class NumbaTraining(TorchEngine):
    """The torch engine with kernels for p2g and the path, both with gradients, for trainings on a CPU."""

    name = "numba training"

    def grid_state(self, particles: Particles, solid: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        model, scales = self.emulator, self.emulator.field_scales
        solid = solid_channels(model.scene, model.grid, model.transfer, particles, solid, torch.float32)
        cells, velocity, gravity, state = Rasterise.apply(  # type: ignore[no-untyped-call]
            self.parameters, particles.position, particles.velocity, scales.of_particles(particles), particles.gravity,
            particles.material, particles.mask, scales.of_scene(particles), solid,
        )  # fmt: skip
        if (volume := particles.volume) is not None and (of_scene := scene_volumes(volume, particles.mask)) is not None:
            factor, (first, end) = state.new_ones(state.shape[:2]), self.parameters.volume_channels
            factor[:, first:end] = of_scene.unsqueeze(1)
            state = state * factor.reshape(*factor.shape, *(1,) * (state.dim() - 2))
        return cells, velocity, gravity, state

    def path(self, start: BundleStart, output: Tensor, context: RolloutContext) -> Tensor:  # noqa: ARG002 (no constraint acts)
        path: Tensor = FreePath.apply(  # type: ignore[no-untyped-call]  # (torch's stubs)
            self.parameters, start.cells, start.velocity, start.gravity, start.material, start.mask, start.state,
            output, self.emulator.output_scale[:, : output.shape[2]],
        )  # fmt: skip
        return path

    def gains(self, start: BundleStart, path: Tensor, rates: Tensor) -> Tensor:
        before = torch.cat([start.cells.unsqueeze(1), path[:, :-1]], dim=1)
        steps: Tensor = Gather.apply(self.parameters, rates, before, start.material)  # type: ignore[no-untyped-call]
        return steps.cumsum(1)


class Rasterise(torch.autograd.Function):
    """Particles in grid units and the grid state, with gradients with respect to positions, velocities and fields."""

    @staticmethod
    def forward(
        ctx: Any, parameters: KernelParameters, position: Tensor, velocity: Tensor, values: Tensor, gravity: Tensor,
        material: Tensor, mask: Tensor, constants: Tensor, solid: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        """(B, N, D) positions, (B, N, D) velocities and (B, 1, D) gravity in cells; (B, C_in, *S) grid state."""
        motion, fields = (as_array(position), as_array(velocity), as_array(gravity)), as_array(values)
        kinds, sizes = material_rows(material, parameters.materials), np.empty((len(position), 0), np.float32)
        arrays = ParticleArrays(*motion, as_array(mask), kinds, sizes, fields, as_array(constants), as_array(solid))
        start = rasterise(parameters, arrays, 0)
        cells, moved = torch.from_numpy(start.path[:, 0]), torch.from_numpy(start.velocity)
        pull, state = torch.from_numpy(start.gravity[:, None]), as_grid(start.state, parameters.shape)
        ctx.parameters = parameters
        ctx.save_for_backward(cells, moved, values, state, material, mask)
        ctx.mark_non_differentiable(pull)
        return cells, moved, pull, state

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients with respect to positions, velocities and fields, from those with respect to the outputs."""
        parameters: KernelParameters = ctx.parameters
        cells, moved, values, state, material, mask = ctx.saved_tensors
        dim, count = moved.shape[2], values.shape[2]
        grad_cells, grad_values = as_copy(grads[0]), np.zeros((*moved.shape[:2], dim + count), np.float32)
        grad_values[..., :dim] = grads[1].numpy()
        sums = as_array(_by_material(state, parameters, count))
        grad_sums = as_copy(_by_material(grads[3], parameters, count)[..., : parameters.materials * (dim + count + 1)])
        carried = as_array(torch.cat([moved, values], dim=2) if count else moved)
        inputs = carried, material_rows(material, parameters.materials), as_array(mask), as_array(cells)
        volume = np.float32(parameters.particle_volume)

        def follow(b: int) -> None:
            each, kind, real, here = (array[b] for array in inputs)
            rasterise_back(
                each, kind, real, here, parameters.grid, sums[b], volume, parameters.box, grad_sums[b], grad_cells[b],
                grad_values[b],
            )  # fmt: skip

        for_each(follow, len(cells), torch.get_num_threads())
        back = torch.from_numpy(grad_values)
        return None, torch.from_numpy(grad_cells), back[..., :dim], back[..., dim:] if count else None, *(None,) * 5


def _by_material(state: Tensor, parameters: KernelParameters, fields: int) -> Tensor:
    """(B, size, M V + M + ...) a state's means of each material's velocities and fields, then its volume fractions."""
    (first, end), materials = parameters.volume_channels, parameters.materials
    rows = state.movedim(1, -1).flatten(1, -2)
    if not fields:
        return rows
    values = rows[..., parameters.first_field : parameters.first_field + materials * fields]
    both = [part.unflatten(-1, (materials, -1)) for part in (rows[..., :first], values)]
    return torch.cat([torch.cat(both, -1).flatten(-2), rows[..., first:end]], -1)


class FreePath(torch.autograd.Function):
    """The free path with gradients with respect to positions, velocities, grid state and network output."""

    @staticmethod
    def forward(ctx: Any, parameters: KernelParameters, *tensors: Tensor) -> Tensor:
        """(B, m, N, D) positions in cells; tensors as of `BundleStart`, and the network's output and scale."""
        start, fields = _to_arrays(parameters, *tensors)
        check_materials(parameters, start.material)

        def move(b: int) -> None:
            find_path(start.scene(b), fields[b], parameters, None, 1)

        for_each(move, len(fields), torch.get_num_threads())
        path = torch.from_numpy(start.path)
        ctx.parameters, ctx.precision = parameters, tensors[-2].dtype
        *others, _, scale = tensors
        ctx.save_for_backward(*others, scale, torch.from_numpy(fields), path)
        return path[:, 1:]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients with respect to cells, velocity, state and output."""
        parameters: KernelParameters = ctx.parameters
        *others, scale, predicted, path = ctx.saved_tensors
        start, fields = _start_arrays(parameters, as_array(path), *others), as_array(predicted)
        grad_path, grad_velocity = np.empty_like(start.path), np.zeros_like(start.velocity)
        grad_path[:, 0], grad_path[:, 1:] = 0, grad.numpy()
        grad_state, grad_fields = np.zeros_like(start.state), np.zeros_like(fields)

        def follow(b: int) -> None:
            scene = start.scene(b)
            path_back(
                scene.path, scene.material, scene.mask, parameters.grid, scene.state, fields[b], parameters.decoder,
                parameters.bounds, grad_path[b], grad_velocity[b], grad_state[b], grad_fields[b],
            )  # fmt: skip

        for_each(follow, len(fields), torch.get_num_threads())
        to_output = torch.from_numpy(grad_fields).movedim(-1, 2).unflatten(3, parameters.shape)
        back = torch.from_numpy(grad_path[:, 0]), torch.from_numpy(grad_velocity), None, None, None
        return None, *back, as_grid(grad_state, parameters.shape), (to_output * scale).to(ctx.precision), None


def _to_arrays(parameters: KernelParameters, *tensors: Tensor) -> tuple[StartArrays, Array]:
    """The start, and the fields (B, m, size, C) of an output; tensors as of `FreePath.forward`."""
    *others, output, scale = tensors
    cells = others[0]
    fields = np.empty((*output.shape[:2], parameters.size, output.shape[2]), np.float32)
    predicted, factors = output_array(output), as_array(scale.flatten(1))
    for_each(lambda b: unpack(predicted[b], factors, fields[b]), len(fields), torch.get_num_threads())
    path = np.empty((len(cells), output.shape[1] + 1, *cells.shape[1:]), np.float32)
    path[:, 0] = cells.detach().numpy()
    return _start_arrays(parameters, path, *others), fields


def _start_arrays(
    parameters: KernelParameters, path: Array, cells: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor,
    mask: Tensor, state: Tensor,
) -> StartArrays:  # fmt: skip
    """The start of a path (B, m + 1, N, D); tensors as of `BundleStart`."""
    rows = as_array(state.movedim(1, -1)).reshape(len(cells), -1, state.shape[1])
    kinds, pull = material_rows(material, parameters.materials), as_array(gravity)[:, 0]
    sizes = np.empty((len(cells), 0), np.float32)
    return StartArrays(path, as_array(velocity), pull, kinds, as_array(mask), sizes, rows)


class Gather(torch.autograd.Function):
    """Interpolation of grid values at each frame, with gradients with respect to values and positions."""

    @staticmethod
    def forward(ctx: Any, parameters: KernelParameters, fields: Tensor, cells: Tensor, material: Tensor) -> Tensor:
        """(B, m, N, V) each particle's own material's values, of fields (B, m, materials * V, *S) at (B, m, N, D)."""
        rows, kinds = as_array(fields.movedim(2, -1).flatten(2, -2)), material_rows(material, parameters.materials)
        here, values = as_array(cells), (0,) * (fields.shape[2] // parameters.materials)
        gathered = np.empty((*here.shape[:3], len(values)), np.float32)

        def follow(b: int) -> None:
            for frame in range(len(here[b])):
                gather(rows[b, frame], kinds[b], here[b, frame], parameters.grid, values, gathered[b, frame])

        for_each(follow, len(here), torch.get_num_threads())
        ctx.parameters = parameters
        ctx.save_for_backward(torch.from_numpy(rows), cells, material)
        return torch.from_numpy(gathered)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients with respect to fields and cells."""
        parameters: KernelParameters = ctx.parameters
        fields, cells, material = ctx.saved_tensors  # once: a checkpoint unpacks each tensor once
        rows, here, pull = as_array(fields), as_array(cells), as_array(grad)
        kinds, real = material_rows(material, parameters.materials), np.ones(here.shape[2], np.bool_)
        grad_rows, grad_cells, values = np.zeros_like(rows), np.zeros_like(here), (0,) * pull.shape[3]

        def follow(b: int) -> None:
            for frame in range(len(here[b])):
                at, back = (here[b, frame], parameters.grid, values), (grad_cells[b, frame], grad_rows[b, frame])
                gather_adjoint(rows[b, frame], kinds[b], real, *at, pull[b, frame], *back)

        for_each(follow, len(here), torch.get_num_threads())
        to_fields = torch.from_numpy(grad_rows).movedim(-1, 2).unflatten(3, parameters.shape)
        return None, to_fields, torch.from_numpy(grad_cells), None


@jit
def path_back(
    path: Any, material: Any, mask: Any, grid: Any, state: Any, fields: Any, decoder: Any, bounds: Any, grad_path: Any,
    grad_velocity: Any, grad_state: Any, grad_fields: Any,
) -> Any:  # fmt: skip
    """Add the gradients of what `find_path` starts from; a position stopped at a bound, or of padding, passes none.

    `grad_path` is overwritten, at the start by that of the positions; `grad_velocity` must hold zeros; the others are
    added to.
    """
    carries, velocities = decoder[3] > ZERO, grid[0]
    for frame in range(len(path) - 1, 0, -1):
        here, grad, target = path[frame - 1], grad_path[frame], grad_path[frame - 1]
        if carries and frame > 1:  # the velocity of the frame before is a difference of positions
            _step_back(path[frame], mask, bounds, grad, target, target)
            earlier = grad_path[frame - 2]
            earlier -= grad
        else:
            _step_back(path[frame], mask, bounds, grad, target, grad_velocity)
        field, grad_field = fields[frame - 1], grad_fields[frame - 1]
        gather_adjoint(field, material, mask, here, grid, velocities, grad, target, grad_field)
    if decoder[1] != ZERO:
        smoothed = decoder[1] * grad_velocity
        gather_adjoint(state, material, mask, path[0], grid, velocities, smoothed, grad_path[0], grad_state)
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
    values: Any, material: Any, mask: Any, cells: Any, grid: Any, state: Any, particle_volume: Any, box: Any,
    grad_state: Any, grad_cells: Any, grad_values: Any,
) -> Any:  # fmt: skip
    """Turn gradients with respect to cells and velocities in cells into those in domain length, the state's added.

    `values` (N, V) are velocities in cells and fields, `grad_state` (size, M V + M) is of their means and of volume
    fractions, as `state`; all three gradients are changed.
    """
    width = values.shape[1]
    materials = grad_state.shape[1] // (width + 1)
    for node in range(len(grad_state)):
        for kind in range(materials):
            volume = materials * width + kind
            count = state[node, volume] / particle_volume
            for k in range(kind * width, (kind + 1) * width):
                grad_state[node, k] /= count if count > np.float32(LEAST_SHARE) else ONE
            grad_state[node, volume] *= particle_volume
    scatter_adjoint(values, material, mask, cells, grid, state, grad_state, grad_cells, grad_values)
    for p in range(len(grad_cells)):
        for d in range(cells.shape[1]):
            grad_cells[p, d] /= box[1, d]
            grad_values[p, d] /= box[1, d]
