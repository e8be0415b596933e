"""Similarity: cells and a stride in which a foreign scene is, for a model, one like its own.

The network knows cells and frames only. Two scenes are the same problem where g Δt²/h, in cells per frame squared, the
particles per cell, and speeds in cells per frame agree, whatever the units of length and time. `find_match` chooses the
size of the cells, h, and how many frames of the data are one of the model.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from nmpm.emulator.experience import Experience, Figures, clamp, gravity_in_cells, mean_width
from nmpm.emulator.match_report import MatchReport
from nmpm.emulator.material_names import describe_materials, match_materials
from nmpm.emulator.model import Emulator
from nmpm.emulator.recipe import EmulatorRecipe
from nmpm.emulator.similar_grid import SimilarGrid, aligned_scales, similar_grid
from nmpm.emulator.turns import find_turn
from nmpm.errors import ConfigError
from nmpm.scene import Motion, Reading, Scene

_WHOLE = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20)
STRIDES = tuple(Fraction(k) for k in _WHOLE) + tuple(Fraction(1, k) for k in _WHOLE[1:])
"""Frames of the data for one of the model that are tried."""
_SHIFTS = tuple(1 + 0.002 * i for i in sorted(range(-20, 21), key=abs))
"""Factors on the best size of cells that are tried, for walls as in the model's scenes."""
_SPEED_COST, _STRIDE_COST, _BETWEEN_COST, _WALL_COST = 0.5, 0.01, 0.04, 0.01
"""Weights of speeds beyond the model's, of the squared logarithms of strides k and 1/k, and of misfits of walls."""
_BLOCK_COST = 0.06
"""Of each axis whose end lies elsewhere in the blocks of cells that the network coarsens to one than in its training:
there a model of one box errs up to ten times as much, even in free fall."""
_COARSE_COST = 0.3
"""Of the squared logarithm by which a box is fewer cells across: heaps and gaps of few cells are predicted worst."""
_SAME_UNITS = 4.0
"""Factor between the distances of particles of scenes that may be in the same unit of length."""
_ROUNDING = 1e-6
"""Relative difference of lengths that are the same in two units."""
_MOST_CELLS = 4_000_000
_UNKNOWN = Motion()


@dataclass(frozen=True)
class Match:
    """How a model takes foreign data.

    Args:
        recipe: The model's form over the data's scene, in the data's units.
        reading: How the data are read for it.
        lines: Cells, frames, gravity, particles and materials, a line each, to be checked by eye; axes where they are
            not the model's.
        warnings: What could not be matched, with its factor.
        gravity: The data's over the model's, in cells per frame²; None where one has none, or several.
    """

    recipe: EmulatorRecipe
    reading: Reading
    lines: tuple[str, ...]
    warnings: tuple[str, ...]
    gravity: float | None = None


def find_match(
    emulator: Emulator,
    scene: Scene,
    motion: Motion = _UNKNOWN,
    materials: Mapping[str, str] | None = None,
    stride: Fraction | None = None,
    strict: bool = False,
    names: tuple[str, str] = ("the model", "the data"),
) -> Match:
    """The cells, the stride, the axes and the materials with which a model takes the scenes of foreign data.

    Where the data's gravity points along another axis than that of the model's training, the network works in turned
    axes: states, rollouts and the recipe's scene stay in the data's.

    A scene in the model's units, with its time step and gravity and a domain of whole cells, keeps the model's cells,
    as `EmulatorRecipe.over` does.

    Args:
        emulator: The model.
        scene: The data's, in units of their own.
        motion: How the data move, as far as that has been measured.
        materials: The model's material by the data's name; those left out are as the aliases of the model's scene say,
            or told by their names.
        stride: Frames of the data for one of the model, k or 1/k; the best of `STRIDES` if left out.
        strict: Whether to refuse what could not be matched.
        names: Of model and data, for messages.

    Raises:
        ConfigError: if the numbers of axes differ, the materials cannot be told, the grid would be too large, or, in
            strict mode, there would be a warning.
    """
    if scene.dim != emulator.scene.dim:
        raise ConfigError(f"{names[0]} has {emulator.scene.dim} axes, {names[1]} {scene.dim}: no model for these data.")
    if stride is not None and (stride <= 0 or 1 not in (stride.numerator, stride.denominator)):
        raise ConfigError(f"stride = {stride}: give k or 1/k frames of the data for one of the model, k whole.")
    measured = not scene.gravity_known and motion.gravity is not None
    scene = dataclasses.replace(scene, gravity=motion.gravity) if measured else scene
    theirs = emulator.scene.materials
    known = {name: to for name, to in emulator.scene.aliases if name in scene.materials}
    given = known | dict(materials or {})
    renamed = match_materials(theirs, scene.materials, given, names)
    turn = find_turn(emulator, scene)
    scene, motion = scene.turned(turn), motion.turned(turn)
    aliases = tuple((name, to) for name, to in (dict(emulator.scene.aliases) | renamed).items() if to != name)
    on_channels = dataclasses.replace(_with_channels_of(emulator.scene, scene), aliases=aliases)
    search = _Search(emulator, on_channels, motion, Experience.of(emulator))
    recipe, step = search.find(stride, names)
    figures = Figures.of(scene, motion, recipe.grid.spacing, step)
    report = MatchReport(emulator.recipe, recipe, scene, step, search.seen, figures, measured, names, turn)
    warnings = tuple(report.warnings())
    if strict and warnings:
        raise ConfigError(f"{' '.join(warnings)} Without strict these are warnings.")
    told = describe_materials(renamed, theirs, given, names[0])
    lines = (*report.lines(), f"materials  {told}{'; obstacles -> solid channel' * scene.obstacles}")
    differing = {name: to for name, to in renamed.items() if to != name}
    gravity, recipe = _gravity_ratio(recipe, emulator.recipe), recipe.turned(turn.inverse)
    reading = Reading(recipe.scene, differing, *step.as_integer_ratio())
    return Match(recipe, reading, lines, warnings, gravity)


def _gravity_ratio(recipe: EmulatorRecipe, model: EmulatorRecipe) -> float | None:
    """A recipe's gravity in cells per frame² over the model's; None where one has none, or several."""
    data, usual = (gravity_in_cells(of.scene.gravity, of.scene.dt, of.grid.spacing) for of in (recipe, model))
    return data / usual if data and usual else None


def _with_channels_of(model: Scene, scene: Scene) -> Scene:
    """A scene of the data with the model's materials, fields and channels, in the data's units."""
    if scene.materials != model.materials:
        scene = dataclasses.replace(scene, materials=model.materials, densities=model.densities)
    moving = scene.moving_obstacles or model.moving_obstacles
    return dataclasses.replace(
        scene.with_fields_of(model),
        gravity_varies=scene.gravity_varies or model.gravity_varies,
        obstacles=scene.obstacles or moving,
        moving_obstacles=moving,
    )


@dataclass(frozen=True)
class _Search:
    """The search for cells and stride.

    Args:
        emulator: The model.
        scene: The data's, with the model's channels but units and a domain of its own.
        motion: The data's.
        seen: The figures of the model's training.
    """

    emulator: Emulator
    scene: Scene
    motion: Motion
    seen: Experience

    def find(self, stride: Fraction | None, names: tuple[str, str]) -> tuple[EmulatorRecipe, Fraction]:
        """The form of the model and the stride, this one or the best; the model's own cells where they fit as they are.

        Raises:
            ConfigError: if there would be too many cells.
        """
        kept = self._same_data() or self._same_cells()
        if kept and stride in (None, kept[1]):
            return kept
        grids = (
            (each, similar_grid(self.emulator.recipe, self.scene, scale))
            for each in ([stride] if stride else self._strides())
            for scale in self._scales(each)
        )
        stride, grid = min(grids, key=lambda choice: round(self._cost(*choice), 9))  # in all units the same of equals
        if math.prod(grid.cells) > _MOST_CELLS:
            raise ConfigError(
                f"{names[1]} would need {' x '.join(map(str, grid.cells))} cells of {mean_width(grid.widths):.3g}"
                f" length for {names[0]}, more than {_MOST_CELLS:,}: its bounds {list(self.scene.bounds)} are wide for"
                f" particles that are {self.scene.particle_spacing:.3g} apart. State narrower ones (data.bounds)."
            )
        return self._recipe(grid, stride), stride

    def _same_data(self) -> tuple[EmulatorRecipe, Fraction] | None:
        """The model's form and stride for recordings such as it was fine-tuned on; None for others."""
        mine, theirs = self.emulator.scene, self.scene
        stride = Fraction(mine.dt / theirs.dt).limit_denominator(max(_WHOLE))
        whole = 1 in stride.as_integer_ratio() and math.isclose(float(stride) * theirs.dt, mine.dt)
        others = not {"domain", "dt", "obstacles"}.issuperset(mine.differences(theirs))
        if self.motion.rms is None or others or not whole:
            return None
        obstacles = theirs.obstacles or mine.obstacles
        scene = dataclasses.replace(theirs, domain=mine.domain, dt=mine.dt, obstacles=obstacles)
        return dataclasses.replace(self.emulator.recipe, scene=scene), stride

    def _same_cells(self) -> tuple[EmulatorRecipe, Fraction] | None:
        """The model's cells for a scene with its time step and gravity that it knows, in any unit; None for others."""
        for unit in self._units():
            try:
                recipe = self.emulator.recipe.over(self._in_unit(unit))
            except ConfigError:
                continue
            figures = self._figures([unit * width for width in recipe.grid.spacing], Fraction(1))
            fewest, most = self.seen.spacings
            dense = fewest * (1 - _ROUNDING) <= figures.spacing <= most * (1 + _ROUNDING)
            fits = dense and math.isclose(self.seen.motion_factor(figures), 1.0)
            if fits or (unit == 1.0 and not recipe.scene.gravity_varies):
                return dataclasses.replace(recipe, scene=self.scene), Fraction(1)
        return None

    def _units(self) -> Iterator[float]:
        """Lengths of the data that may be one of the model's: the likeliest first."""
        mine, theirs = self.emulator.scene, self.scene
        apart = theirs.particle_spacing / mine.particle_spacing
        sides = [(b[1] - b[0]) / (a[1] - a[0]) for a, b in zip(mine.domain, theirs.domain, strict=True)]
        same_box = max(sides) <= min(sides) * (1 + _ROUNDING)
        if same_box and math.isclose(sides[0], apart, rel_tol=_ROUNDING):
            yield 1.0 if math.isclose(apart, 1.0) else sides[0]
        decimal = round(math.log10(apart))
        powers = [10.0**power for power in range(decimal - 1, decimal + 2)]
        powers.sort(key=lambda unit: abs(math.log(apart / unit)))
        yield from (unit for unit in powers if 1 / _SAME_UNITS < apart / unit < _SAME_UNITS)
        if same_box:
            yield sides[0]

    def _in_unit(self, unit: float) -> Scene:
        """The scene with lengths in a unit, of the data's."""
        scene = self.scene
        if unit == 1.0:
            return scene
        bounds, domain = (
            tuple((low / unit, high / unit) for low, high in sides) for sides in (scene.bounds, scene.domain)
        )
        gravity, usual = scene.gravity and tuple(value / unit for value in scene.gravity), self.emulator.scene.gravity
        if gravity and usual and math.dist(gravity, usual) <= _ROUNDING * math.hypot(*usual):
            gravity = usual
        volume = scene.particle_volume / unit**scene.dim
        return dataclasses.replace(scene, bounds=bounds, domain=domain, gravity=gravity, particle_volume=volume)

    def _strides(self) -> Iterator[Fraction]:
        """Those of `STRIDES` with which trajectories are long enough for a start and a bundle of the model's frames."""
        frames = self.motion.frames
        most = max(1, (frames - 1) // (self.emulator.frames + 1)) if frames else max(STRIDES)
        return (stride for stride in STRIDES if stride <= most)

    def _scales(self, stride: Fraction) -> Iterator[float]:
        """Lengths of the data for one of the model, about that of the least cost if cells had no walls to fit.

        At the model's spacing of particles, gravity or speeds are a factor too large. Where cells are wider by x, they
        are a factor / x: log²(factor / x) + w log² x is least at x = factor ** (1 / (1 + w)).
        """
        emulator = self.emulator
        at_one = self._figures(emulator.grid.spacing, stride)
        usual = at_one.scaled(self.seen.spacing / at_one.spacing)
        wider = self.seen.motion_factor(usual) ** (1 / (1 + self.seen.spacing_weight))
        scale = clamp(usual.spacing * wider, *self.seen.spacings) / at_one.spacing
        yield from (scale * shift for shift in _SHIFTS)
        yield from aligned_scales(emulator.recipe, self.scene, scale, emulator.processor.alignment)

    def _cost(self, stride: Fraction, grid: SimilarGrid) -> float:
        figures, seen = self._figures(grid.widths, stride), self.seen
        cost = (
            _deviation(seen.motion_factor(figures))
            + seen.spacing_weight * _deviation(figures.spacing / seen.spacing)
            + _SPEED_COST * _deviation(max(1.0, seen.speed_excess(figures)))
            + (_STRIDE_COST if stride > 1 else _BETWEEN_COST) * math.log(stride) ** 2
            + _WALL_COST * grid.misfit
        )
        return cost if seen.varied_spacing else cost + self._shape_cost(grid.cells)

    def _shape_cost(self, cells: Sequence[int]) -> float:
        """What a model of one box pays for another shape: other blocks at the ends of axes, and fewer cells across."""
        block, usual = self.emulator.processor.alignment, self.emulator.grid.shape
        out_of_block = sum(n % block != m % block for n, m in zip(cells, usual, strict=True))
        coarser = math.log(max(1.0, math.prod(usual) / math.prod(cells))) / len(cells)
        return _BLOCK_COST * out_of_block + _COARSE_COST * coarser**2

    def _figures(self, widths: Sequence[float], stride: Fraction) -> Figures:
        return Figures.of(self.scene, self.motion, widths, stride)

    def _recipe(self, grid: SimilarGrid, stride: Fraction) -> EmulatorRecipe:
        """The model's form on a grid over the data, without a limit on energy that would not hold there."""
        recipe, frame = self.emulator.recipe, self.scene.dt * stride.numerator / stride.denominator
        scene = dataclasses.replace(self.scene, domain=grid.domain, dt=frame)
        if recipe.scene.walled and not scene.walled:
            scene = dataclasses.replace(scene, obstacles=True)  # the solid channel is there, and empty
        conserved = recipe.constraints.energy and scene.gravity_known and scene.is_closed
        constraints = dataclasses.replace(recipe.constraints, energy=conserved)
        return dataclasses.replace(recipe, scene=scene, cells=grid.cells, constraints=constraints)


def _deviation(factor: float) -> float:
    """The squared logarithm of gravity, speeds or particles over the model's, half of it where they are too many.

    Too much is the smaller evil: flight is exact and many particles average well, but what moves too little per frame
    comes to rest early, and few particles leave holes.
    """
    return (0.5 if factor > 1 else 1.0) * math.log(factor) ** 2
