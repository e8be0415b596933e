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
        widths: Of a cell, along each axis.
        misfit: Cells² by which layers at the upper ends are thicker than the model's, added over the axes.
    """

    domain: tuple[Interval, ...]
    cells: tuple[int, ...]
    widths: tuple[float, ...]
    misfit: float


def similar_grid(recipe: EmulatorRecipe, scene: Scene, scale: float) -> SimilarGrid:
    """The grid over a scene's bounds with `scale` times as long cells as the model's, in the data's units.

    Layers beyond the bounds are as thick as the model's, in cells, at the lower end of an axis, and at least as thick
    at the upper one. Without layers, and on periodic axes, the cells are the nearest number that the network takes.
    """
    axes = []
    for axis, (bounds, kind, width) in enumerate(zip(scene.bounds, scene.boundary, recipe.grid.spacing, strict=True)):
        takes = _network_takes(recipe, periodic=kind == "periodic")
        layers = _layers(recipe, axis, kind)
        if kind == "periodic" or (kind == "wall" and layers == (0, 0)):
            axes.append((bounds, _nearest_cells((bounds[1] - bounds[0]) / (scale * width), takes), 0.0))
        else:
            axes.append(_walled_axis(bounds, scale * width, layers, takes))
    domain, cells, misfits = zip(*axes, strict=True)
    widths = tuple((high - low) / n for (low, high), n in zip(domain, cells, strict=True))
    return SimilarGrid(domain, cells, widths, sum(misfits))


def aligned_scales(recipe: EmulatorRecipe, scene: Scene, scale: float, alignment: int) -> list[float]:
    """Scales up to a third apart from one at which an axis has whole blocks of `alignment` cells, walls included."""
    scales = []
    for axis, (bounds, kind, width) in enumerate(zip(scene.bounds, scene.boundary, recipe.grid.spacing, strict=True)):
        extent, walls = (bounds[1] - bounds[0]) / width, sum(_layers(recipe, axis, kind))
        blocks = (extent / scale + walls) / alignment
        numbers = (n for n in range(round(blocks) - 2, round(blocks) + 3) if 0.75 <= n / blocks <= 4 / 3)
        scales += [extent / (n * alignment - walls) for n in numbers if n * alignment > walls]
    return scales


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


def _nearest_cells(cells: float, takes: Callable[[int], bool]) -> int:
    """The whole number of cells that the network takes nearest to this one."""
    nearest = range(max(1, math.floor(cells) - _TRIES), math.ceil(cells) + _TRIES)
    return next(filter(takes, sorted(nearest, key=lambda n: abs(math.log(n / cells)))), max(1, round(cells)))


def _walled_axis(
    bounds: Interval, width: float, layers: Interval, takes: Callable[[int], bool]
) -> tuple[Interval, int, float]:
    """Domain, cells and misfit of an axis with layers beyond its bounds, as thick as given in cells, or more."""
    needed = layers[0] + (bounds[1] - bounds[0]) / width + layers[1]
    least = max(1, math.ceil(needed - _SAME))
    cells = next(filter(takes, range(least, least + _TRIES)), least)
    lower = bounds[0] - layers[0] * width
    return (lower, max(lower + cells * width, bounds[1])), cells, max(0.0, cells - needed) ** 2


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
