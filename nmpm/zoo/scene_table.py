"""A table of the scenes that a zoo's models were made for, by which one chooses among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nmpm._support.bounded_files import read_yaml
from nmpm.scene import Scene
from nmpm.zoo.building import read_recipe

COLUMNS = ("model", "materials", "box", "particles", "ms between frames", "gravity", "obstacles", "cells", "m")
TEXT = """\
What scenes the models were made for: size of the box and gravity in the units of the data (length, length / s²), the
usual number of particles, cells of the grid, and the frames m that one call predicts. Another box, other numbers of
particles and, where there is a wall or an obstacle already, other obstacles are possible (`model.over(scene)`); other
materials, gravity or time between frames are not.
"""


def scene_table(rows: Sequence[str]) -> list[str]:
    """The lines of the table, of rows made by `scene_row`, below what it shows."""
    return [TEXT, f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}", *rows]


def scene_row(name: str, folder: Path, card: Mapping[str, Any]) -> str:
    """The row of an entry, of its name, folder and card.

    Raises:
        DataError: if the entry's recipe cannot be read.
    """
    recipe = read_recipe(read_yaml(folder / "config.yaml"))
    scene = recipe.scene
    cells = (
        f"[{name}]({name}/README.md)",
        ", ".join(scene.materials),
        " × ".join(f"{high - low:.3g}" for low, high in scene.bounds),
        str(card.get("particles", "")),
        f"{1e3 * scene.dt:.3g}",
        _gravity(scene),
        "yes" if scene.obstacles else "no",
        " × ".join(str(count) for count in recipe.grid.shape),
        str(recipe.frames),
    )
    return f"| {' | '.join(cells)} |"


def _gravity(scene: Scene) -> str:
    if scene.gravity_varies:
        return "any"
    if scene.gravity is None:
        return "unknown"
    return "(" + ", ".join(f"{value:.3g}" for value in scene.gravity) + ")"
