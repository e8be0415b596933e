"""Obstacles with parameters that gradients reach: a ramp's angle, a disc's radius, a polygon's corners.

Each body knows its signed distance, from which `nmpm.emulator.bodies` rasterises it softly: as the share of each grid
cell that is solid. So a loss on a rollout has gradients with respect to all of its parameters, sizes among them:

    angle = torch.tensor(-0.4, requires_grad=True)
    state = model.state(position, bodies=[Ramp((0.5, 0.4), length=0.3, thickness=0.03, angle=angle)])
    loss = model.differentiable_rollout(state, frames=100)[:, -1].sub(target).norm(dim=-1).mean()
    loss.backward()

In three dimensions there are `Box` and `Sphere`.

`Body.particles` fills a body with particles, as the bodies of the training data are: for datasets, simulators and
files. Their number is counted from the body's sizes, and has no gradient.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from nmpm.errors import ConfigError

Number = float | Tensor
Point = Sequence[Number] | Tensor

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
"""Turns by it never come near to repeating (Vogel 1979)."""


class Body(abc.ABC):
    """An obstacle.

    Attributes:
        dim: D, dimensions of the scenes that it belongs to.
    """

    dim: ClassVar[int]

    @abc.abstractmethod
    def distance(self, points: Tensor) -> Tensor:
        """Signed distance from the body's outline, negative inside, exact everywhere.

        Args:
            points: (..., D) in domain length, on the CPU.

        Returns:
            (...) float64, differentiable with respect to the body's parameters and to the points.

        Raises:
            ConfigError: if a size is not positive, or a parameter is not finite.
        """

    @abc.abstractmethod
    def particles(self, spacing: float) -> Tensor:
        """Particles that fill the body, one per spacing^D.

        Args:
            spacing: Distance between them, in domain length: that of the scene's particles suits.

        Returns:
            (M, D) float64 positions in domain length, differentiable with respect to the body's parameters.

        Raises:
            ConfigError: if the spacing is not positive, or the body is too small for a single particle.
        """


def box_distance(local: Tensor, sides: Tensor) -> Tensor:
    """(...) signed distances from a box.

    Args:
        local: (..., D) points from the box's centre, along its sides.
        sides: (D,) whole lengths.
    """
    beyond = local.abs() - sides / 2
    # On the outline the part for the inside, as a norm has no derivative at 0.
    outside: Tensor = beyond.clamp(min=0).norm(dim=-1)
    return torch.where((beyond > 0).any(-1), outside, beyond.amax(-1))


def lattice(sides: Sequence[Tensor], spacing: float) -> Tensor:
    """(M, D) points that fill a box of D sides around 0, about `spacing` apart and half of that from its faces."""
    axes = []
    for side in sides:
        number = count(float(side.detach()) / spacing, "side", side)
        axes.append(((torch.arange(number, dtype=torch.float64) + 0.5) / number - 0.5) * side)
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(axes))


def count(number: float, name: str, value: Tensor) -> int:
    """The number rounded, at least 1; ConfigError, naming the size that it follows from, unless it is positive."""
    if not (math.isfinite(number) and number > 0):
        raise ConfigError(f"An obstacle's {name} = {float(value.detach()):g} must be a positive number.")
    return max(1, round(number))


def check_spacing(spacing: float) -> None:
    """Raise ConfigError unless the distance between particles is positive."""
    if not (math.isfinite(spacing) and spacing > 0):
        raise ConfigError(f"spacing = {spacing} must be a positive number.")


def size(name: str, value: Number) -> Tensor:
    """A length in float64, with its gradient; ConfigError unless it is positive."""
    length = tensor(value)
    count(float(length.detach()), name, length)
    return length


def finite(name: str, value: Number | Point) -> Tensor:
    """A parameter in float64, with its gradient; ConfigError unless it is finite."""
    numbers = tensor(value)
    if not numbers.detach().isfinite().all():
        raise ConfigError(f"An obstacle's {name} = {numbers.tolist()} must be finite.")
    return numbers


def tensor(value: Number | Point) -> Tensor:
    """In float64 on the CPU, with gradients of what is a tensor."""
    if isinstance(value, Tensor):
        return value.cpu().double()
    if isinstance(value, Sequence):
        return torch.stack([tensor(each) for each in value])
    return torch.tensor(float(value), dtype=torch.float64)


_ON_EDGE = 1e-9  # share of a triangle: lattice points on a polygon's edges are inside, whatever their rounding


@dataclass(frozen=True, eq=False)
class Ramp(Body):
    """A bar: a turned rectangle.

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
        return tensor(self.centre) + lattice([tensor(self.length), tensor(self.thickness)], spacing) @ self._axes()

    def _axes(self) -> Tensor:
        """(2, 2) unit vectors along and across the bar, as rows."""
        angle = finite("angle", self.angle)
        cos, sin = torch.cos(angle), torch.sin(angle)
        return torch.stack([torch.stack([cos, sin]), torch.stack([-sin, cos])])


@dataclass(frozen=True, eq=False)
class Disc(Body):
    """A disc.

    Args:
        centre: (x, y) in domain length.
        radius: In domain length.
    """

    dim: ClassVar[int] = 2

    centre: Point
    radius: Number

    def distance(self, points: Tensor) -> Tensor:
        offset = points - finite("centre", self.centre)
        distance: Tensor = torch.linalg.vector_norm(offset, dim=-1) - size("radius", self.radius)
        return distance

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
    """A convex polygon.

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
    points = (low + high) / 2 + lattice(list(high - low), spacing)
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
        return _three("centre", self.centre) + lattice(list(self._sides()), spacing) @ self._axes()

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
        distance: Tensor = torch.linalg.vector_norm(points - _three("centre", self.centre), dim=-1)
        return distance - size("radius", self.radius)

    def particles(self, spacing: float) -> Tensor:
        """Particles on spirals over nested spheres, with equal volume each; see `Body.particles`."""
        check_spacing(spacing)
        radius = tensor(self.radius)
        number = count(4 / 3 * math.pi * float(radius.detach()) ** 3 / spacing**3, "radius", radius)
        shells = max(1, round(float(radius.detach()) / spacing))
        return _three("centre", self.centre) + radius * _unit_ball(number, shells)


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
    numbers = finite(name, value)
    if numbers.shape != (3,):
        raise ConfigError(f"An obstacle's {name} = {numbers.tolist()} must be three numbers.")
    return numbers


__all__ = ["Body", "Box", "Disc", "Number", "Point", "Polygon", "Ramp", "Sphere"]
