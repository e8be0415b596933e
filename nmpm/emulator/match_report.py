"""A match in words: the lines that a physicist can check, and what was left over."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

from nmpm.emulator.experience import Experience, Figures, clamp, mean_width
from nmpm.emulator.recipe import EmulatorRecipe
from nmpm.emulator.turns import cosine, describe_turn
from nmpm.scene import Boundary, Scene, Turn

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
