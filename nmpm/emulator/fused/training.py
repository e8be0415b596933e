"""The steps around the network with gradients, for trainings on a CPU: p2g, and the way through a bundle.

They are for linear transfers and bounds that stop particles, in 2-D (`Plan.trains`). Each scene of a batch is a
thread's work, so that results do not depend on how many threads there are. Second derivatives are an error. Torch's
operators with gradients (`torch.library.register_autograd`) take 0.2 ms a call more than these functions, as long as
the kernels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nmpm._support.threads import for_each
from nmpm.emulator.fused.adjoint import fly_back, rasterise_back
from nmpm.emulator.fused.arrays import as_array, as_copy, check_materials, material_rows, output_arrays
from nmpm.emulator.fused.batch import rasterise_batch, to_grid
from nmpm.emulator.fused.path import SceneArrays, fly_scene
from nmpm.emulator.fused.plan import Plan


class Rasterise(torch.autograd.Function):
    """Particles in grid units and the grid state, with gradients with respect to positions and velocities."""

    @staticmethod
    def forward(
        ctx: Any, plan: Plan, position: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor, mask: Tensor,
        solid: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        """(B, N, D) positions, (B, N, D) velocities and (B, 1, D) gravity in cells; (B, C_in, *S) grid state."""
        kinds = material_rows(material, len(plan.mass))
        batch = rasterise_batch(
            plan, as_array(position), as_array(velocity), as_array(gravity), kinds, as_array(mask), as_array(solid)
        )
        cells, moved, pull = map(torch.from_numpy, (batch.cells, batch.velocity, batch.gravity))
        pull, state = pull.unsqueeze(1), to_grid(plan, batch.state)
        ctx.plan = plan
        ctx.save_for_backward(cells, moved, state, material, mask)
        ctx.mark_non_differentiable(pull)
        return cells, moved, pull, state

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients with respect to positions and velocities, from those with respect to cells, moved and state."""
        plan: Plan = ctx.plan
        cells, moved, state, material, mask = ctx.saved_tensors
        place, speed = as_copy(slopes[0]), as_copy(slopes[1])
        channels = plan.volume_channels[1]
        slope = as_copy(slopes[3][:, :channels].movedim(1, -1)).reshape(len(cells), -1, channels)
        rows = as_array(state.movedim(1, -1)).reshape(*slope.shape[:2], -1)
        inputs = as_array(moved), material_rows(material, len(plan.mass)), as_array(mask), as_array(cells)
        volume = np.float32(plan.particle_volume)

        def follow(b: int) -> None:
            speeds, kind, real, here = (values[b] for values in inputs)
            rasterise_back(
                speeds, kind, real, here, plan.scatter_grid, rows[b], volume, plan.box, slope[b], place[b], speed[b]
            )

        for_each(follow, len(cells), torch.get_num_threads())
        return None, torch.from_numpy(place), torch.from_numpy(speed), *(None,) * 4


class FreePath(torch.autograd.Function):
    """`Advection.free_path` with gradients with respect to positions, velocities, grid state and network output."""

    @staticmethod
    def forward(
        ctx: Any, plan: Plan, cells: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor, mask: Tensor,
        state: Tensor, output: Tensor, scale: Tensor,
    ) -> Tensor:  # fmt: skip
        """(B, m, N, D) positions in cells; arguments as of `emulator.bundle.BundleStart`."""
        starts = _Starts(plan, cells, velocity, gravity, material, mask, state, output, scale)
        check_materials(plan, starts.material)
        path = np.empty((len(cells), output.shape[1], *cells.shape[1:]), np.float32)

        def fly(b: int) -> None:
            fly_scene(starts[b], plan, None, path[b], 1)

        for_each(fly, len(cells), torch.get_num_threads())
        found = torch.from_numpy(path)
        ctx.plan = plan
        ctx.save_for_backward(cells, velocity, gravity, material, mask, state, output, scale, found)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients with respect to cells, velocity, state and output."""
        plan: Plan = ctx.plan
        *tensors, found = ctx.saved_tensors
        cells, _, _, _, _, state, output, scale = tensors
        starts, path = _Starts(plan, *tensors), as_array(found)
        place, speed = np.zeros((2, *cells.shape), np.float32)
        of_state = np.zeros((len(cells), math.prod(plan.shape), state.shape[1]), np.float32)
        of_fields = np.zeros((*output.shape[:2], of_state.shape[1], output.shape[2]), np.float32)

        def follow(b: int) -> None:
            own = starts[b]
            fly_back(
                own.cells, own.material, own.mask, plan.gather_grid, own.state, own.fields, plan.shares, plan.limits,
                path[b], as_copy(slope[b]), place[b], speed[b], of_state[b], of_fields[b],
            )  # fmt: skip

        for_each(follow, len(cells), torch.get_num_threads())
        grid = torch.from_numpy(of_state).movedim(-1, 1).unflatten(2, plan.shape)
        fields = torch.from_numpy(of_fields).movedim(-1, 2).unflatten(3, plan.shape)
        back = (torch.from_numpy(place), torch.from_numpy(speed), None, None, None, grid)
        return None, *back, (fields * scale).to(output.dtype), None


class _Starts:
    """The arrays of each scene of a batch; arguments as of `FreePath`."""

    def __init__(self, plan: Plan, *tensors: Tensor) -> None:
        cells, velocity, gravity, material, mask, state, output, scale = tensors
        self.material = material_rows(material, len(plan.mass))
        rows = as_array(state.movedim(1, -1)).reshape(len(cells), -1, state.shape[1])
        self._arrays = as_array(cells), as_array(velocity), self.material, as_array(mask), as_array(gravity)[:, 0], rows
        self._output, self._unpack = output_arrays(output)
        self._scale, self._shape = as_array(scale).reshape(-1), (output.shape[1], rows.shape[1], output.shape[2])

    def __getitem__(self, scene: int) -> SceneArrays:
        fields = np.empty(self._shape, np.float32)
        self._unpack(self._output[scene], self._scale, fields)
        here, speed, kind, real, fall, grid = (values[scene] for values in self._arrays)
        return SceneArrays(here, speed, kind, real, fall, grid, fields)
