"""The network on windows of the grid around the particles, for large scenes that are mostly empty.

Where particles may be during a bundle is estimated from their velocities, as accelerations are not known before the
network has run. Only crops of the grid around these cells are computed; the others are NaN in the output. A bundle that
comes out non-finite has read one of them, and is predicted again from the whole grid.
"""

from __future__ import annotations

import math
import sys
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.engines.rules import RUNTIMES, refusal
from nmpm.emulator.runtimes.grid_crops import BLOCK, CALL_CELLS, Axis, Blocks, GridCrop, cover_blocks, predict_on_crops
from nmpm.emulator.runtimes.runtime import Eager, Runtime, refuse_gradients
from nmpm.errors import ConfigError
from nmpm.processors import GridProcessor

if TYPE_CHECKING:
    from nmpm.emulator.bundle import Bundle, RolloutContext
    from nmpm.emulator.model import Emulator
    from nmpm.particles import Particles

WORTHWHILE = 0.85
"""Part of the grid's cells that windows may have in all; with more, planning and copying them does not pay."""
_SLACK = 3.0  # cells by which particles may leave straight paths at constant velocity,
_FASTER = 1.25  # whose velocities are taken this much larger


class Windows(Runtime):
    """Computes the network on windows where these have fewer cells than the grid, else as `Eager`.

    Args:
        most_cells: Cells that the network computes at once at most, to bound its memory, unless windows would become
            narrower than three times its radius. None for no limit.

    Raises ConfigError if that is not positive.
    """

    name: ClassVar[str] = "windows"
    fixed_shapes: ClassVar[bool] = False
    automatic: ClassVar[bool] = False

    def __init__(self, most_cells: int | None = None) -> None:
        if most_cells is not None and most_cells < 1:
            raise ConfigError(f"Windows.most_cells = {most_cells}: it must be at least 1.")
        self._most = most_cells or sys.maxsize

    def unsupported_reason(self, emulator: Emulator) -> str:
        return refusal(self.name, RUNTIMES, emulator)

    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        return Eager().fields(network, grid, precision)

    def bundle(self, emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
        refuse_gradients(self, emulator, *(value for value in vars(particles).values() if isinstance(value, Tensor)))
        network, grid = emulator.processor, emulator.grid
        axes = [
            Axis(cells, wraps, network.radius or 0, network.alignment)
            for cells, wraps in zip(grid.shape, grid.periodic, strict=True)
        ]
        size = len(particles.position) * grid.size
        reachable = _reachable_blocks(emulator, particles, axes)
        crops = self._cover(reachable, axes)
        cost = sum(crop.cells for crop in crops) + CALL_CELLS * len(crops)
        if crops and (cost <= WORTHWHILE * size or size > self._most):
            bundle = self._predict(emulator, particles, context, crops, axes)
            if all(bool(values.isfinite().all()) for values in (bundle.position, *bundle.fields.values())):
                return bundle
        if size <= self._most:
            return emulator.predict(particles, context)
        everywhere = self._cover(np.ones_like(reachable), axes)
        return self._predict(emulator, particles, context, everywhere, axes)

    def _cover(self, blocks: Blocks, axes: list[Axis]) -> list[GridCrop]:
        return [crop for scene, marked in enumerate(blocks) for crop in cover_blocks(marked, axes, scene, self._most)]

    def _predict(
        self, emulator: Emulator, particles: Particles, context: RolloutContext, crops: list[GridCrop], axes: list[Axis]
    ) -> Bundle:
        return emulator.with_runtime(_Crops(crops, axes, self._most)).predict(particles, context)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return type(self)(self._most)

    def __reduce__(self) -> tuple[type[Self], tuple[Any, ...]]:
        return type(self), (self._most,)


class _Crops(Runtime):
    """The network on the crops of one call; arguments as of `predict_on_crops`."""

    name: ClassVar[str] = "windows"
    fixed_shapes: ClassVar[bool] = False

    def __init__(self, crops: list[GridCrop], axes: list[Axis], most: int) -> None:
        self._crops, self._axes, self._most = crops, axes, most

    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        on_crop = partial(Eager().fields, network, precision=precision)
        return predict_on_crops(on_crop, grid, self._crops, self._axes, self._most)


def _reachable_blocks(emulator: Emulator, particles: Particles, axes: list[Axis]) -> Blocks:
    """(B, *blocks), True where a particle, padding included, may be in one of the next frames."""
    cells, velocity, _ = emulator.in_cells(particles)
    sizes = np.array([axis.cells for axis in axes])
    start = cells.detach().cpu().numpy()
    way = np.nan_to_num(emulator.frames * _FASTER * velocity.detach().cpu().numpy()).clip(-sizes, sizes)
    marks = np.zeros((len(start), *(axis.blocks for axis in axes)), np.bool_)
    scene = np.arange(len(start))[:, None]
    for share in np.linspace(0, 1, int(np.abs(way).max(initial=0) / BLOCK) + 2):
        at = np.nan_to_num(start + share * way, posinf=0, neginf=0).astype(np.int64)
        places = [
            (at[..., index] % axis.cells if axis.periodic else at[..., index].clip(0, axis.cells - 1)) // BLOCK
            for index, axis in enumerate(axes)
        ]
        marks[(scene, *places)] = True
    for index, axis in enumerate(axes, start=1):
        partial = axis.periodic and axis.cells % BLOCK > 0  # its last block is narrower than the slack
        marks = _widen(marks, index, math.ceil(_SLACK / BLOCK) + partial, "wrap" if axis.periodic else "constant")
    return marks


def _widen(marks: Blocks, index: int, by: int, ends: Any) -> Blocks:
    """Marks with their neighbours up to so many blocks away along an axis, whose ends wrap or are walls."""
    padded = np.pad(marks, [(by, by) if axis == index else (0, 0) for axis in range(marks.ndim)], ends)
    views: Any = np.lib.stride_tricks.sliding_window_view(padded, 2 * by + 1, index)
    widened: Blocks = views.any(-1)
    return widened
