"""Obstacles with parameters that gradients reach: a ramp's angle, a disc's radius, a polygon's corners.

Each body knows its signed distance, from which `nmpm.emulator.bodies` rasterises it softly: as the share of each grid
cell that is solid. So a loss on a rollout has gradients with respect to all of its parameters, sizes among them::

    angle = torch.tensor(-0.4, requires_grad=True)
    state = model.state(position, bodies=[Ramp((0.5, 0.4), length=0.3, thickness=0.03, angle=angle)])
    loss = model.differentiable_rollout(state, frames=100)[:, -1].sub(target).norm(dim=-1).mean()
    loss.backward()

`Body.particles` fills a body with particles, as the bodies of the training data are: for datasets, simulators and
files. Their number is counted from the body's sizes, and has no gradient.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.errors import ConfigError

Number = float | Tensor
Point = Sequence[Number] | Tensor

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
_ON_EDGE = 1e-9  # share of a triangle: lattice points on a polygon's edges are inside, whatever their rounding


class Body(abc.ABC):
    """An obstacle in two dimensions."""

    @abc.abstractmethod
    def distance(self, points: Tensor) -> Tensor:
        """Signed distance from the body's outline, negative inside, exact everywhere.

        Args:
            points: (..., 2) in domain length, on the CPU.

        Returns:
            (...) float64, differentiable with respect to the body's parameters and to the points.

        Raises:
            ConfigError: if a size is not positive, or a parameter is not finite.
        """

    @abc.abstractmethod
    def particles(self, spacing: float) -> Tensor:
        """Particles that fill the body, one per spacing².

        Args:
            spacing: Distance between them, in domain length: that of the scene's particles suits.

        Returns:
            (M, 2) float64 positions in domain length, differentiable with respect to the body's parameters.

        Raises:
            ConfigError: if the spacing is not positive, or the body is too small for a single particle.
        """


@dataclass(frozen=True, eq=False)
class Ramp(Body):
    """A bar: a turned rectangle.

    Args:
        centre: (x, y) in domain length.
        length: Of its longer side.
        thickness: Of its shorter side.
        angle: Of the longer side from the x axis, in radians.
    """

    centre: Point
    length: Number
    thickness: Number
    angle: Number

    @classmethod
    def from_end(cls, end: Point, length: Number, thickness: Number, angle: Number) -> Ramp:
        """A bar that starts at `end`, the middle of one of its short sides, and turns about it with the angle."""
        angle = _tensor(angle)
        along = torch.stack([torch.cos(angle), torch.sin(angle)])
        return cls(_tensor(end) + _tensor(length) / 2 * along, length, thickness, angle)

    def distance(self, points: Tensor) -> Tensor:
        sides = torch.stack([_size("length", self.length), _size("thickness", self.thickness)])
        offset = points - _finite("centre", self.centre)
        beyond = (offset @ self._axes().T).abs() - sides / 2
        # On the outline the part for the inside, as a norm has no derivative at 0.
        outside: Tensor = beyond.clamp(min=0).norm(dim=-1)
        return torch.where((beyond > 0).any(-1), outside, beyond.amax(-1))

    def particles(self, spacing: float) -> Tensor:
        _check_spacing(spacing)
        along, across = (_lattice(_tensor(side), spacing) for side in (self.length, self.thickness))
        local = torch.stack(torch.meshgrid(along, across, indexing="ij"), dim=-1).reshape(-1, 2)
        return _tensor(self.centre) + local @ self._axes()

    def _axes(self) -> Tensor:
        """(2, 2) unit vectors along and across the bar, as rows."""
        angle = _finite("angle", self.angle)
        cos, sin = torch.cos(angle), torch.sin(angle)
        return torch.stack([torch.stack([cos, sin]), torch.stack([-sin, cos])])


@dataclass(frozen=True, eq=False)
class Disc(Body):
    """A disc.

    Args:
        centre: (x, y) in domain length.
        radius: In domain length.
    """

    centre: Point
    radius: Number

    def distance(self, points: Tensor) -> Tensor:
        offset = points - _finite("centre", self.centre)
        found: Tensor = torch.linalg.vector_norm(offset, dim=-1) - _size("radius", self.radius)
        return found

    def particles(self, spacing: float) -> Tensor:
        """Particles on a spiral with equal area each (Vogel 1979), one per spacing²; see `Body.particles`."""
        _check_spacing(spacing)
        radius = _tensor(self.radius)
        count = _count(math.pi * float(radius.detach()) ** 2 / spacing**2, "radius", radius)
        index = torch.arange(count, dtype=torch.float64)
        turn = index * _GOLDEN_ANGLE
        unit = torch.stack([torch.cos(turn), torch.sin(turn)], dim=-1) * ((index + 0.5) / count).sqrt().unsqueeze(-1)
        return _tensor(self.centre) + radius * unit


@dataclass(frozen=True, eq=False)
class Polygon(Body):
    """A convex polygon.

    Args:
        corners: (K, 2) in domain length, K at least 3, in order along the outline.

    Raises:
        ConfigError: if there are fewer corners, or the outline is not convex.
    """

    corners: Sequence[Point] | Tensor

    def __post_init__(self) -> None:
        corners = _finite("corners", self._corners()).detach()
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
        _check_spacing(spacing)
        corners = self._corners()
        weights = _fan_weights(corners.detach(), spacing)
        if not len(weights):
            raise ConfigError(f"No lattice point with spacing = {spacing} lies within the polygon.")
        return weights @ corners

    def _corners(self) -> Tensor:
        if isinstance(self.corners, Tensor):
            return _tensor(self.corners)
        return torch.stack([_tensor(corner) for corner in self.corners])


def _fan_weights(corners: Tensor, spacing: float) -> Tensor:
    """(M, K) shares of the corners in the lattice points inside, by the triangles that the first corner makes."""
    low, high = corners.amin(0), corners.amax(0)
    axes = [_lattice(side, spacing) + side / 2 for side in high - low]
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


def _lattice(side: Tensor, spacing: float) -> Tensor:
    """Places along a side, about `spacing` apart and half of that from its ends, counted from its middle."""
    count = _count(float(side.detach()) / spacing, "side", side)
    return ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * side


def _count(number: float, name: str, value: Tensor) -> int:
    if not (math.isfinite(number) and number > 0):
        raise ConfigError(f"An obstacle's {name} = {float(value.detach()):g} must be a positive number.")
    return max(1, round(number))


def _check_spacing(spacing: float) -> None:
    if not (math.isfinite(spacing) and spacing > 0):
        raise ConfigError(f"spacing = {spacing} must be a positive number.")


def _size(name: str, value: Number) -> Tensor:
    size = _tensor(value)
    _count(float(size.detach()), name, size)
    return size


def _finite(name: str, value: Number | Point) -> Tensor:
    found = _tensor(value)
    if not found.detach().isfinite().all():
        raise ConfigError(f"An obstacle's {name} = {found.tolist()} must be finite.")
    return found


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _tensor(value: Number | Point) -> Tensor:
    """In float64 on the CPU, with gradients of what is a tensor."""
    if isinstance(value, Tensor):
        return value.cpu().double()
    if isinstance(value, Sequence):
        return torch.stack([_tensor(each) for each in value])
    return torch.tensor(float(value), dtype=torch.float64)
