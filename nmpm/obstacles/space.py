"""Bodies in three dimensions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from nmpm.errors import ConfigError
from nmpm.obstacles.body import (
    GOLDEN_ANGLE,
    Body,
    Number,
    Point,
    box_distance,
    check_spacing,
    count,
    finite,
    lattice,
    size,
    tensor,
)


@dataclass(frozen=True, eq=False)
class Box(Body):
    """A turned box: a ramp, a wall, a step, a pillar.

    Args:
        centre: (x, y, z) in domain length.
        sides: Its three whole lengths, before it is turned.
        rotation: Axis of the turn times its angle in radians; (0, 0, 0) for none.
    """

    dim: ClassVar[int] = 3

    centre: Point
    sides: Point
    rotation: Point = (0.0, 0.0, 0.0)

    def distance(self, points: Tensor) -> Tensor:
        return box_distance((points - _three("centre", self.centre)) @ self._axes().T, self._sides())

    def particles(self, spacing: float) -> Tensor:
        check_spacing(spacing)
        axes = [lattice(side, spacing) for side in self._sides()]
        local = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
        return _three("centre", self.centre) + local @ self._axes()

    def _sides(self) -> Tensor:
        return torch.stack([size("side", side) for side in _three("sides", self.sides)])

    def _axes(self) -> Tensor:
        """(3, 3) unit vectors along the sides, as rows: the rotation's matrix exponential, transposed."""
        x, y, z = _three("rotation", self.rotation)
        none = torch.zeros_like(x)
        cross = torch.stack([torch.stack(row) for row in ((none, -z, y), (z, none, -x), (-y, x, none))])
        turned: Tensor = torch.linalg.matrix_exp(cross)
        return turned.T


@dataclass(frozen=True, eq=False)
class Sphere(Body):
    """A solid sphere.

    Args:
        centre: (x, y, z) in domain length.
        radius: In domain length.
    """

    dim: ClassVar[int] = 3

    centre: Point
    radius: Number

    def distance(self, points: Tensor) -> Tensor:
        found: Tensor = torch.linalg.vector_norm(points - _three("centre", self.centre), dim=-1)
        return found - size("radius", self.radius)

    def particles(self, spacing: float) -> Tensor:
        """Particles on spirals over nested spheres, with equal volume each; see `Body.particles`."""
        check_spacing(spacing)
        radius = tensor(self.radius)
        number = count(4 / 3 * math.pi * float(radius.detach()) ** 3 / spacing**3, "radius", radius)
        return _three("centre", self.centre) + radius * _unit_ball(
            number, max(1, round(float(radius.detach()) / spacing))
        )


def _unit_ball(number: int, shells: int) -> Tensor:
    """(number, 3) points within the unit ball, evenly: in each shell, as many as its volume holds, on one sphere."""
    edges = torch.linspace(0, 1, shells + 1, dtype=torch.float64) ** 3
    middles = ((edges[1:] + edges[:-1]) / 2) ** (1 / 3)
    counts = (number * edges).round().long().diff()
    return torch.cat([middle * _unit_sphere(int(each)) for middle, each in zip(middles, counts, strict=True)])


def _unit_sphere(number: int) -> Tensor:
    """(number, 3) points on the unit sphere with equal area each, on a spiral."""
    index = torch.arange(number, dtype=torch.float64)
    height = 1 - 2 * (index + 0.5) / max(1, number)
    across = (1 - height**2).sqrt()
    turn = index * GOLDEN_ANGLE
    return torch.stack([across * torch.cos(turn), across * torch.sin(turn), height], dim=-1)


def _three(name: str, value: Point) -> Tensor:
    found = finite(name, value)
    if found.shape != (3,):
        raise ConfigError(f"An obstacle's {name} = {found.tolist()} must be three numbers.")
    return found
