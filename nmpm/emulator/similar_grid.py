"""The grid over a foreign scene: whole cells, walls as in the model's scenes, a shape that its network takes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from nmpm.emulator.recipe import EmulatorRecipe
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.scene import Boundary, Interval, Scene

_SAME = 1e-4  # of a cell
_TRIES = 64
_LEAST_LAYER = 1.14
"""Cells of wall that are seen as such, as in goop's scenes; half the error of 0.29 on variablegravity's."""


@dataclass(frozen=True)
class SimilarGrid:
    """A grid over foreign data.

    Args:
        domain: What it covers, (lower, upper) per axis, in the data's units.
        cells: Along each axis.
        misfit: Cells² by which layers at the upper ends are thicker than the model's, added over the axes.
    """

    domain: tuple[Interval, ...]
    cells: tuple[int, ...]
    misfit: float

    @property
    def widths(self) -> tuple[float, ...]:
        """Of a cell, along each axis."""
        return tuple((high - low) / n for (low, high), n in zip(self.domain, self.cells, strict=True))


def similar_grid(recipe: EmulatorRecipe, scene: Scene, scale: float) -> SimilarGrid:
    """The grid over a scene's bounds with `scale` times as long cells as the model's, in the data's units.

    Layers beyond the bounds are as thick as the model's, in cells, at the lower end of an axis, and at least as thick
    at the upper one. Without layers, and on periodic axes, the cells are the nearest number that the network takes.
    """
    axes = [_fit_axis(recipe, scene, axis, scale * width) for axis, width in enumerate(recipe.grid.spacing)]
    domain, cells, misfits = zip(*axes, strict=True)
    return SimilarGrid(domain, cells, sum(misfits))


def aligned_scales(recipe: EmulatorRecipe, scene: Scene, scale: float, alignment: int) -> list[float]:
    """Scales up to a third apart from one at which an axis has whole blocks of `alignment` cells, walls included."""
    scales = []
    for axis, (bounds, kind, width) in enumerate(zip(scene.bounds, scene.boundary, recipe.grid.spacing, strict=True)):
        extent, walls = (bounds[1] - bounds[0]) / width, sum(_layers(recipe, axis, kind))
        blocks = (extent / scale + walls) / alignment
        numbers = (n for n in range(round(blocks) - 2, round(blocks) + 3) if 0.75 <= n / blocks <= 4 / 3)
        scales += [extent / (n * alignment - walls) for n in numbers if n * alignment > walls]
    return scales


def _fit_axis(recipe: EmulatorRecipe, scene: Scene, axis: int, width: float) -> tuple[Interval, int, float]:
    """Domain, number of cells of about a width, and misfit of an axis."""
    (low, high), kind = scene.bounds[axis], scene.boundary[axis]
    takes, (lower, upper) = _network_takes(recipe, kind == "periodic"), _layers(recipe, axis, kind)
    across = (high - low) / width
    if kind == "periodic" or (kind == "wall" and lower == upper == 0):
        near = range(max(1, math.floor(across) - _TRIES), math.ceil(across) + _TRIES)
        nearest_first = sorted(near, key=lambda n: abs(math.log(n / across)))
        return (low, high), next(filter(takes, nearest_first), max(1, round(across))), 0.0
    needed = lower + across + upper
    least = max(1, math.ceil(needed - _SAME))
    cells = next(filter(takes, range(least, least + _TRIES)), least)
    first = low - lower * width
    return (first, max(first + cells * width, high)), cells, max(0.0, cells - needed) ** 2


def _network_takes(recipe: EmulatorRecipe, periodic: bool) -> Callable[[int], bool]:
    """Whether the network takes so many cells along an axis, other axes alike."""
    dim = recipe.scene.dim

    def takes(cells: int) -> bool:
        try:
            recipe.processor.check_grid(Grid((cells,) * dim, (0.0,) * dim, (1.0,) * dim, (periodic,) * dim))
        except ConfigError:
            return False
        return True

    return takes


def _layers(recipe: EmulatorRecipe, axis: int, kind: Boundary) -> Interval:
    """Cells beyond the bounds at an axis' ends in the model's scene; those of another axis of that kind, or none."""
    scene, grid = recipe.scene, recipe.grid
    alike = [each for each, other in enumerate(scene.boundary) if other == kind]
    if not alike:
        return 0.0, 0.0
    source = axis if axis in alike else alike[0]
    (low, high), (first, last), width = scene.bounds[source], scene.domain[source], grid.spacing[source]
    lower, upper = (low - first) / width, (last - high) / width
    # A model of scenes of many kinds knows walls of any thickness: thin ones as those that particles keep off.
    least = _LEAST_LAYER if recipe.particles_per_cell and min(lower, upper) > 0 else 0.0
    return max(lower, least), max(upper, least)
