"""The regular grid that covers a scene's domain.

n cells along an axis of extent L are L / n wide exactly and have their centres at lower + (i + 1/2) L / n. Inside the
emulator, positions are in cells from the lower corner and velocities in cells per frame ("grid units"), so that
neither the origin nor the unit of length matters.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from nmpm.errors import ConfigError, DataError
from nmpm.scene import Scene

_MAX_ROUNDING = 1 / 16  # of a cell: coarser positions are useless
_COUNTING_CELL = 3.0  # particle spacings


@dataclass(frozen=True)
class Grid:
    """A regular grid of cells over a box.

    Args:
        shape: Number of cells along each axis, (x, y[, z]).
        lower: The box's lower corner, in domain length.
        spacing: Cell width along each axis, in domain length.
        periodic: Whether each axis wraps.
    """

    shape: tuple[int, ...]
    lower: tuple[float, ...]
    spacing: tuple[float, ...]
    periodic: tuple[bool, ...]

    @classmethod
    def of(cls, scene: Scene, cells: int | Sequence[int]) -> Self:
        """The grid over a scene's domain.

        Args:
            scene: The scene to cover.
            cells: Cells along each axis, or along the longest one (the others follow, cells as square as they can be).

        Raises:
            ConfigError: if `cells` is not positive or names another number of axes than the scene has.
        """
        extents = [high - low for low, high in scene.domain]
        shape = _cells_along_axes(cells, extents)
        return cls(
            shape=shape,
            lower=tuple(low for low, _ in scene.domain),
            spacing=tuple(extent / n for extent, n in zip(extents, shape, strict=True)),
            periodic=scene.periodic,
        )

    @property
    def dim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of cells in all."""
        return math.prod(self.shape)

    @property
    def cell_volume(self) -> float:
        """Volume of a cell, in length ** dim."""
        return math.prod(self.spacing)

    def to_cells(self, position: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """Positions (..., D) in domain length → cells from the lower corner, of type `dtype`.

        The origin is subtracted in the positions' own precision, so that float64 input far from 0 keeps its digits.

        Raises:
            DataError: if that precision is too coarse so far from 0.
        """
        self.check_precision(position.dtype)
        offset = per_axis(operator.sub, position, self.lower)
        return per_axis(operator.truediv, offset, self.spacing).to(dtype)

    def resolves(self, dtype: torch.dtype, cells: float = _MAX_ROUNDING) -> bool:
        """Whether floating-point numbers at the domain's ends are at most so many cells apart, 1/16 if left out."""
        return self.rounding(dtype) <= cells

    def rounding(self, dtype: torch.dtype) -> float:
        """Largest distance between neighbouring floating-point numbers at the domain's ends, in cells."""
        return max(step / h for _, step, h in self._steps(dtype))

    def check_precision(self, dtype: torch.dtype) -> None:
        """Raises a DataError if numbers at the domain's ends are more than 1/16 of a cell apart."""
        for axis, (reach, step, h) in enumerate(self._steps(dtype)):
            if step > _MAX_ROUNDING * h:
                name = str(dtype).removeprefix("torch.")
                raise DataError(
                    f"{name} numbers have a spacing of {step:g} near {reach:g}, where axis {axis} of the domain ends,"
                    f" and a cell is {h:g} wide. Move the origin into the domain: subtract its lower corner from"
                    " positions, bounds and domain. Only positions passed from Python may be float64 instead; those of"
                    " files are read as float32."
                )

    def _steps(self, dtype: torch.dtype) -> list[tuple[float, float, float]]:
        """For each axis the end that is farthest from 0, the spacing of numbers there, and the cell's width."""
        steps = []
        for low, n, h in zip(self.lower, self.shape, self.spacing, strict=True):
            reach = max(abs(low), abs(low + n * h))
            step = torch.finfo(dtype).eps * 2.0 ** math.floor(math.log2(reach)) if reach > 0 else 0.0
            steps.append((reach, step, h))
        return steps

    def to_cell_displacement(self, displacement: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """Displacements (..., D) in domain length → cells, of type `dtype`."""
        return per_axis(operator.truediv, displacement, self.spacing).to(dtype)

    def to_length(self, cells: Tensor) -> Tensor:
        """Positions (..., D) in cells → domain length."""
        return per_axis(operator.add, self.to_displacement(cells), self.lower)

    def to_displacement(self, cells: Tensor) -> Tensor:
        """Displacements (..., D) in cells → domain length."""
        return per_axis(operator.mul, cells, self.spacing)

    def isotropic_units(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Convert (..., D) values in cells to widths of the first axis' cells: energies need one unit for all axes."""
        first, *others = self.spacing
        if all(abs(other / first - 1) < 1e-6 for other in others):
            return values
        ratios = [spacing / first for spacing in self.spacing]
        return tuple(per_axis(operator.mul, value, ratios) for value in values)

    def bounds_in_cells(self, scene: Scene) -> Tensor:
        """(2, D) lowest and highest positions of a scene, in cells, float32 on torch's default device.

        Computed in float64, which not every device has, on the CPU.
        """
        numbers = (scene.bounds, self.lower, self.spacing)
        limits, lower, spacing = (torch.tensor(values, dtype=torch.float64, device="cpu") for values in numbers)
        return ((limits.T - lower) / spacing).float().to(torch.get_default_device())

    def centres(self, axis: int, dtype: torch.dtype = torch.float64) -> Tensor:
        """Cell centres along an axis, (n,), in domain length, on the CPU."""
        index = torch.arange(self.shape[axis], dtype=dtype, device="cpu")
        return self.lower[axis] + (index + 0.5) * self.spacing[axis]


def counting_grid(scene: Scene) -> Grid:
    """The grid of cells of 3 particle spacings, in which measures count particles."""
    longest = max(high - low for low, high in scene.domain)
    return Grid.of(scene, max(1, round(longest / (_COUNTING_CELL * scene.particle_spacing))))


def per_axis(operation: Callable[[Tensor, float], Tensor], values: Tensor, numbers: Sequence[float]) -> Tensor:
    """Apply an operation to (..., D) values with a number of its own for each axis.

    A tensor of the numbers would be copied to the device in each call.
    """
    first, *others = numbers
    if all(number == first for number in others):
        return operation(values, first)
    columns = zip(values.unbind(-1), numbers, strict=True)
    return torch.stack([operation(column, number) for column, number in columns], dim=-1)


def _cells_along_axes(cells: int | Sequence[int], extents: Sequence[float]) -> tuple[int, ...]:
    if isinstance(cells, int):
        width = max(extents) / max(cells, 1)
        shape = tuple(max(1, round(extent / width)) for extent in extents)
        valid = cells >= 1
    else:
        shape = tuple(cells)
        valid = len(shape) == len(extents) and min(shape) >= 1
    if not valid:
        raise ConfigError(
            f"A grid of {cells} cells does not fit a scene with {len(extents)} axes: give one positive number, "
            "or one for each axis."
        )
    return shape
