"""The training error's sums over particles as Numba kernels with gradients, for a CPU.

Each scene is a thread's work, so that results do not depend on how many threads there are. Second derivatives are an
error.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nmpm._support.jit import jit, jit_sum
from nmpm._support.threads import for_each
from nmpm.emulator.engines.numba.arrays import as_array, material_rows
from nmpm.emulator.engines.numba.scatter import scatter, scatter_adjoint
from nmpm.grid import Grid

ZERO = np.float32(0)
_LINEAR = (0, 0)
_NONE = np.empty((0, 0), np.float32)


class PositionErrors(torch.autograd.Function):
    """`losses.position_errors` with gradients with respect to the predicted positions."""

    @staticmethod
    def forward(ctx: Any, predicted: Tensor, target: Tensor, mask: Tensor, grid: Grid, frames: int) -> Tensor:
        """(B, T / frames) errors; arguments as of `losses.position_errors`, float32."""
        errors = np.empty((len(predicted), predicted.shape[1] // frames), np.float32)
        spacing = np.array(grid.spacing, np.float32)

        def measure(b: int) -> None:
            sum_squares(as_array(predicted[b]), as_array(target[b]), as_array(mask[b]), spacing, frames, errors[b])

        for_each(measure, len(errors), torch.get_num_threads())
        ctx.save_for_backward(predicted, target, mask)
        ctx.spacing, ctx.frames = spacing, frames
        return torch.from_numpy(errors)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        """The gradient with respect to the predicted positions."""
        predicted, target, mask = ctx.saved_tensors
        gradients, pull = np.empty(predicted.shape, np.float32), as_array(slope)

        def follow(b: int) -> None:
            arrays = as_array(predicted[b]), as_array(target[b]), as_array(mask[b])
            square_gradients(*arrays, ctx.spacing, ctx.frames, pull[b], gradients[b])

        for_each(follow, len(gradients), torch.get_num_threads())
        return torch.from_numpy(gradients), None, None, None, None


class Counts(torch.autograd.Function):
    """The number of particles of each material on the nodes by linear weights, with gradients to their positions."""

    @staticmethod
    def forward(ctx: Any, cells: Tensor, material: Tensor, mask: Tensor, grid: Grid, materials: int) -> Tensor:
        """(B, F, size, M) numbers, of (B, F, N, D) positions in cells and (B, N) materials, on a grid of 2 axes."""
        counts = np.zeros((*cells.shape[:2], grid.size, materials), np.float32)
        none, kinds = np.empty((cells.shape[2], 0), np.float32), material_rows(material, materials)
        space = (grid.shape, grid.periodic, _LINEAR)

        def add(b: int) -> None:
            kind, real, here = kinds[b], as_array(mask[b]), as_array(cells[b])
            for frame in range(len(here)):
                scatter(none, kind, real, here[frame], space, counts[b, frame])

        for_each(add, len(cells), torch.get_num_threads())
        ctx.save_for_backward(cells, material, mask)
        ctx.grid = grid
        return torch.from_numpy(counts)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        """The gradient with respect to the positions."""
        cells, material, mask = ctx.saved_tensors
        grid: Grid = ctx.grid
        gradient, pull = np.zeros(cells.shape, np.float32), as_array(slope)
        none, kinds = np.empty((cells.shape[2], 0), np.float32), material_rows(material, slope.shape[-1])
        space = (grid.shape, grid.periodic, _LINEAR)

        def follow(b: int) -> None:
            kind, real, here = kinds[b], as_array(mask[b]), as_array(cells[b])
            for frame in range(len(here)):
                scatter_adjoint(
                    none, kind, real, here[frame], space, _NONE, pull[b, frame], gradient[b, frame], none
                )  # fmt: skip

        for_each(follow, len(cells), torch.get_num_threads())
        return torch.from_numpy(gradient), None, None, None, None


@jit_sum
def sum_squares(predicted: Any, target: Any, mask: Any, spacing: Any, frames: Any, errors: Any) -> Any:
    """Fill in the `errors` (T / frames,) of the bundles of a scene, of positions (T, N, D) and `spacing` (D,)."""
    axes, scale = predicted.shape[2], 1 / (frames * predicted.shape[2] * np.float64(mask.sum()))
    for bundle in range(len(errors)):
        total = 0.0
        for frame in range(bundle * frames, (bundle + 1) * frames):
            for d in range(axes):
                part = ZERO
                for p in range(len(mask)):
                    way = (predicted[frame, p, d] - target[frame, p, d]) / spacing[d]
                    part += way * way if mask[p] else ZERO
                total += np.float64(part)
        errors[bundle] = total * scale


@jit
def square_gradients(predicted: Any, target: Any, mask: Any, spacing: Any, frames: Any, slope: Any, out: Any) -> Any:
    """Fill in `out` (T, N, D), the gradient with respect to `predicted`, from `slope` (T / frames,); see above."""
    scale = 2 / (frames * predicted.shape[2] * np.float64(mask.sum()))
    for frame in range(len(predicted)):
        for d in range(predicted.shape[2]):
            factor = np.float32(scale * slope[frame // frames] / (spacing[d] * spacing[d]))
            for p in range(len(mask)):
                out[frame, p, d] = factor * (predicted[frame, p, d] - target[frame, p, d]) if mask[p] else ZERO
