"""Similarity: cells and a stride in which a foreign scene is, for a model, one like its own.

The network knows cells and frames only. Two scenes are the same problem where g Δt²/h, in cells per frame squared, the
particles per cell, and speeds in cells per frame agree, whatever the units of length and time. `find_match` chooses the
size of the cells, h, and how many frames of the data are one of the model.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from types import MappingProxyType

from nmpm._support.messages import suggestion
from nmpm.emulator.experience import Experience, Figures, clamp, gravity_in_cells, mean_width
from nmpm.emulator.model import Emulator
from nmpm.emulator.recipe import EmulatorRecipe
from nmpm.emulator.turns import cosine, describe_turn, find_turn
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.scene import Boundary, Interval, Motion, Reading, Scene, Turn

_WORDS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "sand": ("grain", "granul", "gravel", "soil", "powder"),
        "water": ("fluid", "liquid"),
        "goop": ("jelly", "snow", "elastic"),
    }
)
"""Parts of other programs' names for the materials of the zoo."""


def match_materials(
    model: Sequence[str], data: Sequence[str], given: Mapping[str, str], sides: tuple[str, str]
) -> dict[str, str]:
    """The model's material for each of the data.

    Those that are not given are told by the same name, then by a part of it or a word for it; a model of one material
    takes everything.

    Args:
        model: Names of the model's materials.
        data: Names of the data's.
        given: The model's name by the data's, as the user states it.
        sides: Names of model and data, for messages.

    Raises:
        ConfigError: if a given name is on neither side, or a material of the data cannot be told.
    """
    _check_given(given, sides[1], data)
    _check_given(given.values(), sides[0], model)
    only = model[0] if len(model) == 1 else None
    names = {name: given.get(name) or _told(name, model) or only for name in data}
    unknown = [name for name, to in names.items() if to is None]
    if unknown:
        raise ConfigError(
            f"{sides[1]} has {', '.join(data)}; {sides[0]} has {', '.join(model)}. State which is which: --materials"
            f" {','.join(f'{name}={to or model[0]}' for name, to in names.items())} (in Python materials={{"
            f"{unknown[0]!r}: {model[0]!r}, …}})."
        )
    return {name: str(to) for name, to in names.items()}


def describe_materials(names: Mapping[str, str], model: Sequence[str], given: Container[str], side: str) -> str:
    """What `match_materials` gives in words, such as "big, small -> sand (proposed from the names)"."""
    groups = {theirs: [name for name, to in names.items() if to == theirs] for theirs in names.values()}
    text = "; ".join(f"{', '.join(of_data)} -> {theirs}" for theirs, of_data in groups.items())
    if all(name in given or name.casefold() == to.casefold() for name, to in names.items()):
        return text
    return f"{text} (the only material of {side})" if len(model) == 1 else f"{text} (proposed from the names)"


def _check_given(given: Iterable[str], side: str, names: Sequence[str]) -> None:
    for name in given:
        if name not in names:
            raise ConfigError(
                f"materials: {side} has no {name!r} but {', '.join(names)}.{suggestion(name, names)}"
                " Give the data's name first: --materials big=sand."
            )


def _told(name: str, model: Sequence[str]) -> str | None:
    """The model's material that a name means; None if that cannot be told, or could be two."""
    if name in model:
        return name
    plain, words = name.casefold(), {theirs: theirs.casefold() for theirs in model}
    same = [theirs for theirs, word in words.items() if word == plain]
    near = [theirs for theirs, word in words.items() if any(part in plain for part in (word, *_WORDS.get(word, ())))]
    candidates = same or near
    return candidates[0] if len(candidates) == 1 else None


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


_GRAVITY, _SPEED, _SPACING = 1.25, 2.0, 1.05
"""Left-over factors beyond which there is a warning; the model's speeds are estimates."""
_ALIGNED = 0.99  # cosine of the angle between two directions of gravity


@dataclass(frozen=True)
class MatchReport:
    """What is said of a match.

    Args:
        model: The model's recipe, in its own units.
        recipe: Its form over the data's scene.
        scene: The data's, in the model's axes.
        stride: Frames of the data for one of the model.
        seen: The figures of the model's training.
        figures: Those of the data.
        measured: Whether the data's gravity is not stated but measured.
        names: Of model and data.
        turn: From the data's axes to the model's.
    """

    model: EmulatorRecipe
    recipe: EmulatorRecipe
    scene: Scene
    stride: Fraction
    seen: Experience
    figures: Figures
    measured: bool
    names: tuple[str, str]
    turn: Turn

    def lines(self) -> Iterator[str]:
        """Cells, frames, gravity and particles, a line each."""
        recipe, figures, seen, scene = self.recipe, self.figures, self.seen, self.recipe.scene
        sides = zip(scene.bounds, scene.domain, recipe.grid.spacing, scene.confined, strict=True)
        walls = [f" with walls of {(low - first) / h:.2g} cells" for (low, _), (first, _), h, wall in sides if wall]
        yield (
            f"cells      1 cell = {mean_width(recipe.grid.spacing):.4g} length (model"
            f" {mean_width(self.model.grid.spacing):.4g}), {' x '.join(map(str, recipe.grid.shape))} cells"
            f"{''.join(walls[:1])}"
        )
        yield f"frames     1 frame of the model = {self.stride} of the data ({scene.dt:.4g} time)"
        yield f"gravity    {self._gravity_line()}"
        few, many = (n**scene.dim for n in seen.spacings)
        usual = f"{few:.2g} to {many:.2g}" if seen.varied_spacing else f"{seen.spacing**scene.dim:.3g}"
        yield (
            f"particles  {figures.spacing**scene.dim:.3g} per cell (model {usual}); speeds up to"
            f" {_number(figures.largest)} cells/frame (model {_number(seen.fastest)})"
        )
        if not self.turn.is_identity:
            yield f"axes       {describe_turn(self.turn)}"

    def _gravity_line(self) -> str:
        figures, seen = self.figures, self.seen
        unknown = "none" if self.scene.gravity_known else "unknown"
        data = unknown if figures.gravity is None else f"{figures.gravity:.3g} cells/frame²"
        weakest, strongest = seen.gravity or (None, None)
        from_weakest = f"{weakest:.3g} to " if weakest and self.model.scene.gravity_varies else ""
        both = f"{data}{' as measured' * self.measured} (model {from_weakest}{_number(strongest)})"
        if figures.gravity and seen.gravity:
            return f"{both}, factor {seen.motion_factor(figures):.3g}"
        if figures.rms and seen.rms:
            return f"{both}; by speeds, rms {figures.rms:.3g} cells/frame (model {seen.rms:.3g})"
        return f"{both}; by the particles alone"

    def warnings(self) -> Iterator[str]:
        """What was left over, a sentence each with model, data and factor."""
        if not self._has_gravity_of_model:
            yield from self._gravity_warnings()
        yield from self._figure_warnings()
        yield from self._boundary_warnings()

    @property
    def _has_gravity_of_model(self) -> bool:
        """Whether gravity and frames are the model's, number for number, on cells of its size."""
        same = {"dt", "gravity", "gravity_varies"}.isdisjoint(self.model.scene.differences(self.scene))
        widths = zip(self.model.grid.spacing, self.recipe.grid.spacing, strict=True)
        return same and all(math.isclose(a, b, rel_tol=1e-3) for a, b in widths)

    def _gravity_warnings(self) -> Iterator[str]:
        (model, data), figures, seen = self.names, self.figures, self.seen
        factor = seen.motion_factor(figures)
        if figures.gravity and seen.gravity:
            if not 1 / _GRAVITY <= factor <= _GRAVITY:
                yield f"Gravity of {data} is {figures.gravity:.3g} cells/frame², {factor:.3g} times that of {model}."
            yield from self._direction_warnings()
            return
        varies, mine, theirs = self.model.scene.gravity_varies, self.model.scene, self.scene
        if not theirs.gravity_known and mine.gravity_known:
            yield (
                f"Gravity of {data} is not known, that of {model} is: state it, even if there is none, by --gravity"
                " (fit: --data.gravity; in Python: gravity=…)."
            )
        elif theirs.gravity_varies and not varies:
            yield f"Gravity differs between the scenes of {data}; {model} has seen one."
        elif seen.gravity and not varies and not figures.gravity:
            yield f"{data} has no gravity, but {model} learnt to fall by {seen.gravity[1]:.3g} cells/frame²."
        elif figures.gravity and not varies:
            yield f"{data} has a gravity of {figures.gravity:.3g} cells/frame²; {model} has seen none."
        if figures.rms and seen.rms:
            if not 1 / _SPEED <= factor <= _SPEED:
                yield f"Speeds of {data} are {figures.rms:.3g} cells/frame (rms), {factor:.3g} times those of {model}."
        elif not figures.gravity:
            yield f"Neither gravity nor speeds of {data} are known: cells for {model} are chosen by particles alone."

    def _direction_warnings(self) -> Iterator[str]:
        (model, data), mine, theirs = self.names, self.model.scene, self.scene
        if mine.gravity_varies:
            return
        if theirs.gravity is None:
            yield f"Gravity differs between the scenes of {data}; {model} has seen one."
        elif mine.gravity is not None and cosine(mine.gravity, theirs.gravity) < _ALIGNED:
            gravity = list(self.turn.inverse.vector(theirs.gravity))
            yield (
                f"Gravity of {data} points along {gravity}, between its axes, that of {model} along"
                f" {list(mine.gravity)}: turn the data."
            )

    def _figure_warnings(self) -> Iterator[str]:
        (model, data), figures, seen = self.names, self.figures, self.seen
        factor, excess = figures.spacing / clamp(figures.spacing, *seen.spacings), seen.speed_excess(figures)
        if not 1 / _SPACING <= factor <= _SPACING:
            yield (
                f"{data} has {figures.spacing:.3g} particles to a cell and axis, {factor:.3g} times what {model} has"
                f" seen ({seen.spacings[0]:.3g} to {seen.spacings[1]:.3g})."
            )
        if excess > 1:
            yield (
                f"Speeds of {data} reach {figures.largest:.3g} cells/frame, {excess:.3g} times those that {model} is"
                " calibrated for."
            )

    def _boundary_warnings(self) -> Iterator[str]:
        (model, data), mine, theirs = self.names, self.model.scene, self.scene
        axes: dict[tuple[Boundary, Boundary], list[str]] = {}
        for axis, pair in zip(self.turn.axes, zip(mine.boundary, theirs.boundary, strict=True), strict=True):
            axes.setdefault(pair, []).append(axis.removeprefix("-"))
        for (one, other), names in axes.items():
            if one != other:
                yield f"Along {', '.join(names)} {data} has the boundary {other!r}, {model} was trained with {one!r}."
        if theirs.obstacles and not mine.walled:
            yield f"{data} has obstacles, which the network of {model} does not see."
        if theirs.moving_obstacles and not mine.moving_obstacles:
            yield f"{data} has moving obstacles; the network of {model} does not see their velocities."


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"


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
