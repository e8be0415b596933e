"""A match in words: the lines that a physicist can check, and what was left over."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction

from nmpm.emulator.experience import Experience, Figures, clamp, mean_width
from nmpm.emulator.recipe import EmulatorRecipe
from nmpm.scene import Boundary, Scene

FACTOR = 1.25
"""Left-over factors of gravity beyond which there is a warning."""
_SPEED_FACTOR, _SPACING_FACTOR = 2.0, 1.05
"""Likewise of speeds, of which the model's are estimates, and of the spacing of particles."""
_ALIGNED = 0.99  # cosine of the angle between two directions of gravity


@dataclass(frozen=True)
class MatchReport:
    """What is said of a match.

    Args:
        model: The model's recipe, in its own units.
        recipe: Its form over the data's scene.
        scene: The data's, as it came.
        stride: Frames of the data for one of the model.
        seen: The figures of the model's training.
        figures: Those of the data.
        measured: Whether the data's gravity is not stated but measured.
        names: Of model and data.
    """

    model: EmulatorRecipe
    recipe: EmulatorRecipe
    scene: Scene
    stride: Fraction
    seen: Experience
    figures: Figures
    measured: bool
    names: tuple[str, str]

    def lines(self) -> Iterator[str]:
        """Cells, frames, gravity and particles, a line each."""
        recipe, figures, seen = self.recipe, self.figures, self.seen
        scene, dim = recipe.scene, recipe.scene.dim
        layers = [
            (low - first) / h
            for (low, _), (first, _), h in zip(scene.bounds, scene.domain, recipe.grid.spacing, strict=True)
        ]
        walls = [layer for layer, walled in zip(layers, scene.confined, strict=True) if walled]
        yield (
            f"cells      1 cell = {mean_width(recipe.grid.spacing):.4g} length (model"
            f" {mean_width(self.model.grid.spacing):.4g}), {' x '.join(map(str, recipe.grid.shape))} cells"
            + (f" with walls of {walls[0]:.2g} cells" if walls else "")
        )
        yield f"frames     1 frame of the model = {self.stride} of the data ({scene.dt:.4g} time)"
        yield f"gravity    {self._gravity_line()}"
        few, many = (n**dim for n in seen.spacings)
        usual = f"{few:.2g} to {many:.2g}" if self.model.particles_per_cell else f"{seen.spacing**dim:.3g}"
        yield (
            f"particles  {figures.spacing**dim:.3g} per cell (model {usual}); speeds up to {_number(figures.largest)}"
            f" cells/frame (model {_number(seen.fastest)})"
        )

    def warnings(self) -> Iterator[str]:
        """What was left over, a sentence each with model, data and factor."""
        if not self._same_units:
            yield from self._gravity_warnings()
        yield from self._figure_warnings()
        yield from self._boundary_warnings()

    @property
    def _same_units(self) -> bool:
        """Whether gravity and frames are the model's, number for number, on cells of its size."""
        mine, theirs = self.model.scene, self.scene
        alike = (mine.gravity, mine.gravity_varies, mine.dt) == (theirs.gravity, theirs.gravity_varies, theirs.dt)
        widths = zip(self.model.grid.spacing, self.recipe.grid.spacing, strict=True)
        return alike and all(math.isclose(a, b, rel_tol=1e-3) for a, b in widths)

    def _gravity_line(self) -> str:
        data, model = self.figures.gravity, self.seen.gravity
        told = model and self.model.scene.gravity_varies
        theirs = f"{model[0]:.3g} to {model[1]:.3g}" if model and told else _number(model and model[1])
        none = "none" if self.scene.gravity_known else "unknown"
        measured = " as measured" if self.measured else ""
        both = f"{f'{data:.3g} cells/frame²' if data else none}{measured} (model {theirs})"
        if data and model:
            return f"{both}, factor {self.seen.motion_factor(self.figures):.3g}"
        if self.figures.rms and self.seen.rms:
            return f"{both}; by speeds, rms {self.figures.rms:.3g} cells/frame (model {self.seen.rms:.3g})"
        return f"{both}; by the particles alone"

    def _gravity_warnings(self) -> Iterator[str]:
        model, data = self.names
        figures, seen = self.figures, self.seen
        factor = seen.motion_factor(figures)
        if figures.gravity and seen.gravity:
            if not 1 / FACTOR <= factor <= FACTOR:
                yield f"Gravity of {data} is {figures.gravity:.3g} cells/frame², {factor:.3g} times that of {model}."
            yield from self._direction_warnings()
            return
        told = self.model.scene.gravity_varies
        if not self.scene.gravity_known and (self.model.scene.gravity_known or told):
            yield f"Gravity of {data} is not known, that of {model} is: state it (gravity=…)."
        elif figures.gravity is None and seen.gravity and not told and not self.scene.gravity_varies:
            yield f"{data} has no gravity, but {model} learnt to fall by {seen.gravity[1]:.3g} cells/frame²."
        elif self.scene.gravity_varies and not told:
            yield f"Gravity differs between the scenes of {data}; {model} has seen one."
        elif figures.gravity and not told:
            yield f"{data} has a gravity of {figures.gravity:.3g} cells/frame²; {model} has seen none."
        if figures.rms and seen.rms:
            if not 1 / _SPEED_FACTOR <= factor <= _SPEED_FACTOR:
                yield (
                    f"Speeds of {data} are {figures.rms:.3g} cells/frame (rms), {factor:.3g} times those of {model}."
                )
        elif not figures.gravity:
            yield f"Neither gravity nor speeds of {data} are known: cells for {model} are chosen by particles alone."

    def _direction_warnings(self) -> Iterator[str]:
        model, data = self.model.scene, self.scene
        if model.gravity_varies:
            return
        if data.gravity is None:
            yield f"Gravity differs between the scenes of {self.names[1]}; {self.names[0]} has seen one."
        elif model.gravity is not None and _cosine(model.gravity, data.gravity) < _ALIGNED:
            yield (
                f"Gravity of {self.names[1]} points along {list(data.gravity)}, that of {self.names[0]} along"
                f" {list(model.gravity)}: turn the data."
            )

    def _figure_warnings(self) -> Iterator[str]:
        (model, data), figures, seen = self.names, self.figures, self.seen
        factor = figures.spacing / clamp(figures.spacing, *seen.spacings)
        if not 1 / _SPACING_FACTOR <= factor <= _SPACING_FACTOR:
            yield (
                f"{data} has {figures.spacing:.3g} particles to a cell and axis, {factor:.3g} times what {model} has"
                f" seen ({seen.spacings[0]:.3g} to {seen.spacings[1]:.3g})."
            )
        excess = seen.speed_excess(figures)
        if excess > 1:
            yield (
                f"Speeds of {data} reach {figures.largest:.3g} cells/frame, {excess:.3g} times those that {model} is"
                " calibrated for."
            )

    def _boundary_warnings(self) -> Iterator[str]:
        (model, data), mine, theirs = self.names, self.model.scene, self.scene
        axes: dict[tuple[Boundary, Boundary], list[str]] = {}
        for axis, pair in zip("xyz", zip(mine.boundary, theirs.boundary, strict=True), strict=False):
            axes.setdefault(pair, []).append(axis)
        for (one, other), names in axes.items():
            if one != other:
                yield f"Along {', '.join(names)} {data} has the boundary {other!r}, {model} was trained with {one!r}."
        if theirs.obstacles and not mine.walled:
            yield f"{data} has obstacles, which the network of {model} does not see."
        if theirs.moving_obstacles and not mine.moving_obstacles:
            yield f"{data} has moving obstacles; the network of {model} does not see their velocities."


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"


def _cosine(one: Sequence[float], other: Sequence[float]) -> float:
    return sum(a * b for a, b in zip(one, other, strict=True)) / (math.hypot(*one) * math.hypot(*other))
