"""Bodies in two dimensions."""

from __future__ import annotations

import math
from collections.abc import Sequence
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

_ON_EDGE = 1e-9  # share of a triangle: lattice points on a polygon's edges are inside, whatever their rounding


@dataclass(frozen=True, eq=False)
class Ramp(Body):
    """A bar in two dimensions: a turned rectangle.

    Args:
        centre: (x, y) in domain length.
        length: Of its longer side.
        thickness: Of its shorter side.
        angle: Of the longer side from the x axis, in radians.
    """

    dim: ClassVar[int] = 2

    centre: Point
    length: Number
    thickness: Number
    angle: Number

    @classmethod
    def from_end(cls, end: Point, length: Number, thickness: Number, angle: Number) -> Ramp:
        """A bar that starts at `end`, the middle of one of its short sides, and turns about it with the angle."""
        angle = tensor(angle)
        along = torch.stack([torch.cos(angle), torch.sin(angle)])
        return cls(tensor(end) + tensor(length) / 2 * along, length, thickness, angle)

    def distance(self, points: Tensor) -> Tensor:
        sides = torch.stack([size("length", self.length), size("thickness", self.thickness)])
        return box_distance((points - finite("centre", self.centre)) @ self._axes().T, sides)

    def particles(self, spacing: float) -> Tensor:
        check_spacing(spacing)
        along, across = (lattice(tensor(side), spacing) for side in (self.length, self.thickness))
        local = torch.stack(torch.meshgrid(along, across, indexing="ij"), dim=-1).reshape(-1, 2)
        return tensor(self.centre) + local @ self._axes()

    def _axes(self) -> Tensor:
        """(2, 2) unit vectors along and across the bar, as rows."""
        angle = finite("angle", self.angle)
        cos, sin = torch.cos(angle), torch.sin(angle)
        return torch.stack([torch.stack([cos, sin]), torch.stack([-sin, cos])])


@dataclass(frozen=True, eq=False)
class Disc(Body):
    """A disc in two dimensions.

    Args:
        centre: (x, y) in domain length.
        radius: In domain length.
    """

    dim: ClassVar[int] = 2

    centre: Point
    radius: Number

    def distance(self, points: Tensor) -> Tensor:
        offset = points - finite("centre", self.centre)
        found: Tensor = torch.linalg.vector_norm(offset, dim=-1) - size("radius", self.radius)
        return found

    def particles(self, spacing: float) -> Tensor:
        """Particles on a spiral with equal area each (Vogel 1979), one per spacing²; see `Body.particles`."""
        check_spacing(spacing)
        radius = tensor(self.radius)
        number = count(math.pi * float(radius.detach()) ** 2 / spacing**2, "radius", radius)
        index = torch.arange(number, dtype=torch.float64)
        turn = index * GOLDEN_ANGLE
        unit = torch.stack([torch.cos(turn), torch.sin(turn)], dim=-1) * ((index + 0.5) / number).sqrt().unsqueeze(-1)
        return tensor(self.centre) + radius * unit


@dataclass(frozen=True, eq=False)
class Polygon(Body):
    """A convex polygon in two dimensions.

    Args:
        corners: (K, 2) in domain length, K at least 3, in order along the outline.

    Raises:
        ConfigError: if there are fewer corners, or the outline is not convex.
    """

    dim: ClassVar[int] = 2

    corners: Sequence[Point] | Tensor

    def __post_init__(self) -> None:
        corners = finite("corners", self._corners()).detach()
        if corners.dim() != 2 or corners.shape[0] < 3 or corners.shape[1] != 2:
            raise ConfigError(f"A polygon has three or more corners (x, y); these have shape {tuple(corners.shape)}.")
        sides = corners.roll(-1, 0) - corners
        turns = _cross(sides, sides.roll(-1, 0))
        if not ((turns > 0).all() or (turns < 0).all()):
            raise ConfigError("A polygon's corners must go once around a convex outline: divide it into convex ones.")

    def distance(self, points: Tensor) -> Tensor:
        corners = self._corners()
        sides = corners.roll(-1, 0) - corners
        lengths = sides.norm(dim=-1)
        along = sides / lengths.unsqueeze(-1)
        outward = torch.stack([along[:, 1], -along[:, 0]], dim=-1) * _cross(sides[0], sides[1]).detach().sign()
        offset = points.unsqueeze(-2) - corners  # (..., K, 2)
        beyond = (offset * outward).sum(-1)  # of the line through each side
        place = (offset * along).sum(-1)
        over_side = (place >= 0) & (place <= lengths) & (beyond >= 0)
        outside = torch.minimum(torch.where(over_side, beyond, torch.inf), offset.norm(dim=-1)).amin(-1)
        return torch.where((beyond > 0).any(-1), outside, beyond.amax(-1))

    def particles(self, spacing: float) -> Tensor:
        """Particles of a lattice, each a fixed mean of three corners; see `Body.particles`."""
        check_spacing(spacing)
        corners = self._corners()
        weights = _fan_weights(corners.detach(), spacing)
        if not len(weights):
            raise ConfigError(f"No lattice point with spacing = {spacing} lies within the polygon.")
        return weights @ corners

    def _corners(self) -> Tensor:
        if isinstance(self.corners, Tensor):
            return tensor(self.corners)
        return torch.stack([tensor(corner) for corner in self.corners])


def _fan_weights(corners: Tensor, spacing: float) -> Tensor:
    """(M, K) shares of the corners in the lattice points inside, by the triangles that the first corner makes."""
    low, high = corners.amin(0), corners.amax(0)
    axes = [lattice(side, spacing) + side / 2 for side in high - low]
    points = low + torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 2)
    weights = corners.new_zeros(len(points), len(corners))
    free = torch.ones(len(points), dtype=torch.bool)
    for second in range(1, len(corners) - 1):
        first, b, c = corners[0], corners[second] - corners[0], corners[second + 1] - corners[0]
        offset, area = points - first, _cross(b, c)
        beta, gamma = _cross(offset, c.expand_as(offset)) / area, _cross(b.expand_as(offset), offset) / area
        inside = free & (beta >= -_ON_EDGE) & (gamma >= -_ON_EDGE) & (beta + gamma <= 1 + _ON_EDGE)
        weights[inside, 0] = 1 - beta[inside] - gamma[inside]
        weights[inside, second], weights[inside, second + 1] = beta[inside], gamma[inside]
        free &= ~inside
    return weights[~free]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
