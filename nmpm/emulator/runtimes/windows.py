"""The network on windows of the grid around the particles, for large scenes that are mostly empty.

Where particles may be during a bundle is estimated from their velocities, as accelerations are not known before the
network has run. Only crops of the grid around these cells are computed; the others are NaN in the output. A bundle that
comes out non-finite has read one of them, and is predicted again from the whole grid.

A network with a radius computes a cell from those within it. A crop that is wider than its blocks by the radius, on
each side that is no wall of the grid, therefore gives there what the whole grid would, to rounding.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nmpm.emulator.engines.rules import NETWORKS, refusal
from nmpm.emulator.runtimes.runtime import Eager, Runtime, refuse_gradients
from nmpm.errors import ConfigError
from nmpm.processors import GridProcessor

if TYPE_CHECKING:
    from nmpm.emulator.bundle import Bundle, RolloutContext
    from nmpm.emulator.model import Emulator
    from nmpm.particles import Particles


BLOCK = 4
"""Cells of a block along each axis; the last block of an axis may have fewer."""
CALL_CELLS = 2000
"""Cells that a network computes in the time that a further crop costs beside its cells."""
_STEP = 16  # cells, at least, by which the lengths of crops differ: fewer shapes make larger batches
_READ = 1  # cells from that of a position which transfers interpolate from

Blocks = NDArray[np.bool_]
Box = list[tuple[int, int]]  # of blocks: first and last, exclusive, along each axis


@dataclass(frozen=True)
class Axis:
    """One axis of a grid, in cells, and radius and alignment of the network on it."""

    cells: int
    periodic: bool
    radius: int
    alignment: int

    @property
    def blocks(self) -> int:
        return -(-self.cells // BLOCK)

    @property
    def halo(self) -> int:
        """Cells between positions that may read a crop and its end, where that is no wall."""
        return self.radius + _READ

    def span(self, first: Any, last: Any) -> tuple[Any, Any]:
        """Start and length of the crops in which blocks `first` to `last`, exclusive, may be read; or arrays of them.

        Starts are multiples of the alignment, lengths have the remainder of the whole axis, which the network pads as
        it pads that.
        """
        low = (np.asarray(first) * BLOCK - self.halo) // self.alignment * self.alignment
        high = np.minimum(np.asarray(last) * BLOCK, self.cells) + self.halo
        rest, step = self.cells % self.alignment, -(-_STEP // self.alignment) * self.alignment
        if not self.periodic:
            low, high = np.maximum(low, 0), np.minimum(high, self.cells)
        length = np.maximum(-(-(high - low - rest) // step) * step, 0) + rest
        whole = (length >= self.cells) | (self.periodic and rest > 0)
        start = low if self.periodic else np.minimum(low, self.cells - length)
        return np.where(whole, 0, start), np.where(whole, self.cells, length)

    def exact(self, start: int, length: int) -> tuple[int, int]:
        """First cell and number of the cells of a crop whose output is that of the whole grid."""
        if length == self.cells:
            return start, length
        low = start if start == 0 and not self.periodic else start + self.radius
        high = start + length
        return low, (high if high == self.cells and not self.periodic else high - self.radius) - low

    def slices(self, first: int, count: int) -> list[tuple[slice, slice]]:
        """The cells `first` to `first + count` as one or two slices of the axis, each with where it is among them."""
        first %= self.cells
        kept = min(count, self.cells - first)
        slices = [(slice(first, first + kept), slice(0, kept))]
        return slices if kept == count else [*slices, (slice(0, count - kept), slice(kept, count))]


@dataclass(frozen=True)
class GridCrop:
    """A part of the grid of a scene of the batch: first cell, negative where it wraps, and cells along each axis."""

    scene: int
    start: tuple[int, ...]
    shape: tuple[int, ...]

    @property
    def cells(self) -> int:
        return math.prod(self.shape)

    def take(self, grid: Tensor, axes: Sequence[Axis]) -> Tensor:
        """(1, C, *shape) of a grid (B, C, *S)."""
        part = grid[self.scene : self.scene + 1]
        for index, (axis, start, length) in enumerate(zip(axes, self.start, self.shape, strict=True), start=2):
            slices = axis.slices(start, length)
            parts = [part.narrow(index, there.start, there.stop - there.start) for there, _ in slices]
            part = torch.cat(parts, dim=index) if len(parts) > 1 else parts[0]
        return part

    def put(self, values: Tensor, output: Tensor, axes: Sequence[Axis]) -> None:
        """Copy values (..., *shape) into an output (B, ..., *S), where they are those of the whole grid."""
        sides = []
        for axis, start, length in zip(axes, self.start, self.shape, strict=True):
            first, count = axis.exact(start, length)
            skip = first - start
            slices = axis.slices(first, count)
            sides.append([(there, slice(skip + here.start, skip + here.stop)) for there, here in slices])
        for pairs in product(*sides):
            there, here = zip(*pairs, strict=True)
            output[self.scene][(..., *there)] = values[(..., *here)]


def cover_blocks(blocks: Blocks, axes: Sequence[Axis], scene: int, most: int) -> list[GridCrop]:
    """Crops in which the marked blocks (*blocks) of a scene may be read: boxes are cut while that makes them cheaper.

    A crop has at most so many cells; but boxes narrower than the halo are not cut for that, as it would cost more.
    """
    spans = [
        [axis.span(*ends) for axis, ends in zip(axes, box, strict=True)]
        for box in _cut_boxes(blocks, (0,) * len(axes), axes, most)
    ]
    return [GridCrop(scene, tuple(int(s) for s, _ in sides), tuple(int(n) for _, n in sides)) for sides in spans]


def _cut_boxes(blocks: Blocks, origin: tuple[int, ...], axes: Sequence[Axis], most: int) -> Iterator[Box]:
    """Boxes that hold the marked blocks, of an array that begins at the block `origin`."""
    if not blocks.any():
        return
    marked = [np.flatnonzero(_project(blocks, axis)) for axis in range(blocks.ndim)]
    tight = blocks[tuple(slice(at[0], at[-1] + 1) for at in marked)]
    first = tuple(int(low + at[0]) for low, at in zip(origin, marked, strict=True))
    box = [(low, low + count) for low, count in zip(first, tight.shape, strict=True)]
    cost = math.prod(int(axis.span(*ends)[1]) for axis, ends in zip(axes, box, strict=True))
    cuts = [_cheapest_cut(tight, first, axes, along) for along in range(tight.ndim) if tight.shape[along] > 1]
    least, along, cut = min(cuts, default=(math.inf, 0, 0))
    if least + CALL_CELLS >= cost:
        along = int(np.argmax(tight.shape))
        cut = tight.shape[along] // 2
        if cost <= most or tight.shape[along] * BLOCK <= max(axes[along].halo, BLOCK):
            yield box
            return
    below, above = np.split(tight, [cut], axis=along)
    yield from _cut_boxes(below, first, axes, most)
    yield from _cut_boxes(above, tuple(low + cut * (axis == along) for axis, low in enumerate(first)), axes, most)


def _project(blocks: Blocks, *kept: int) -> Any:
    """Whether any block is marked, for each place along the axes that are kept."""
    return blocks.any(tuple(axis for axis in range(blocks.ndim) if axis not in kept))


def _cheapest_cut(blocks: Blocks, origin: tuple[int, ...], axes: Sequence[Axis], along: int) -> tuple[float, int, int]:
    """Cells, axis and place of the cheapest cut of a tight box across one axis, whose sides shrink to what is marked.

    All cuts at once, by what is marked so far from either end.
    """
    below, above = np.ones(blocks.shape[along] - 1), np.ones(blocks.shape[along] - 1)
    for axis, line in enumerate(axes):
        rows = np.diag(_project(blocks, along)) if axis == along else _project(blocks, along, axis)
        rows = rows.T if axis < along else rows
        below *= _lengths(np.logical_or.accumulate(rows)[:-1], origin[axis], line)
        above *= _lengths(np.logical_or.accumulate(rows[::-1])[-2::-1], origin[axis], line)
    cells = below + above
    cut = int(cells.argmin())
    return float(cells[cut]), along, cut + 1


def _lengths(marks: Blocks, origin: int, axis: Axis) -> Any:
    """(K,) cells along an axis of crops for the range that is marked in each row (K, blocks)."""
    first, last = marks.argmax(1), marks.shape[1] - marks[:, ::-1].argmax(1)
    return axis.span(origin + first, origin + last)[1]


def predict_on_crops(
    network: Callable[[Tensor], Tensor], grid: Tensor, crops: Sequence[GridCrop], axes: Sequence[Axis], most: int
) -> Tensor:
    """A network's output (B, m, C_out, *S) on at least one crop of a grid (B, C_in, *S), NaN in all other cells.

    The network computes `most` cells at once, or one crop.
    """
    parts: list[tuple[GridCrop, Tensor]] = []
    for batch in _equal_shapes(crops, most):
        inputs = torch.cat([crop.take(grid, axes) for crop in batch])
        if grid.dim() == 4:  # the memory layout of the whole grid, see `Emulator`
            inputs = inputs.contiguous(memory_format=torch.channels_last)
        parts += zip(batch, network(inputs), strict=True)
    frames, channels = parts[0][1].shape[:2]
    # One row of values for each node, as the kernels of `nmpm.emulator.engines.numba` read them.
    rows = parts[0][1].new_full((len(grid), *grid.shape[2:], frames, channels), math.nan)
    output = rows.movedim((-2, -1), (1, 2))
    for crop, values in parts:
        crop.put(values, output, axes)
    return output


def _equal_shapes(crops: Sequence[GridCrop], most: int) -> Iterator[list[GridCrop]]:
    """Crops of equal shape together, of at most so many cells in all."""
    for shape in dict.fromkeys(crop.shape for crop in crops):
        equal = [crop for crop in crops if crop.shape == shape]
        count = max(1, most // equal[0].cells)
        yield from (equal[first : first + count] for first in range(0, len(equal), count))


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
    features: ClassVar[frozenset[str]] = frozenset(
        {
            "machines without OpenVINO",
            "models on other devices than a CPU",
            "networks in other precisions than float32 and bfloat16",
        }
    )

    def __init__(self, most_cells: int | None = None) -> None:
        if most_cells is not None and most_cells < 1:
            raise ConfigError(f"Windows.most_cells = {most_cells}: it must be at least 1.")
        self._most = most_cells or sys.maxsize

    def unsupported_reason(self, emulator: Emulator) -> str:
        return refusal(NETWORKS, emulator, self.features)

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
