"""The grid of the material point method, and what its walls do.

Nodes are the centres of square cells of size h that fill the box, and of one more cell around it, so that a particle in
cell i feels the nodes i, i + 1 and i + 2, counted from the outer cell. The wall acts at the centres of the outer and of
the first inner cells. A particle's velocity towards the wall then falls with the square of its distance from the box's
side, and it cannot cross. Walls that hold on to material act at the centres of the second inner cells as well, where
particles then stop; the box's sides are a cell further out.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

from nmpm.sim.arrays import Array
from nmpm.sim.mpm.obstacle_field import ObstacleField


class Walls(enum.Enum):
    """What the box's sides do with material that moves away from them."""

    SEPARATE = "separate"
    """Let it go: they push and brake, and never pull."""

    SLIP = "slip"
    """Hold it, so that it only slides along."""

    OPEN_CORNERS = "slip, open corners"
    """Hold it; but at the very corner, the first node of both walls, along the first axis alone, so that material that
    slides down a side is not stopped a cell above the floor. The solver of DeepMind's recorded water does so."""


@dataclass(frozen=True)
class MpmGrid:
    """Square cells, cubes in three dimensions, that fill a box.

    Args:
        low: (D,) lower corner of the box, in length.
        size: Side of a cell, in length.
        shape: Cells along each axis.
        friction: Coulomb friction of the walls.
        gravity: (D,) acceleration, in length per second squared.
        walls: How the box's sides treat material.
        obstacles: Within the box; None without.
    """

    low: Array
    size: float
    shape: tuple[int, ...]
    friction: float
    gravity: Array
    walls: Walls = Walls.SEPARATE
    obstacles: ObstacleField | None = None
