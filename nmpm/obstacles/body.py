"""The contract of bodies, and the checks and lattices that they share."""

from __future__ import annotations

import abc
import math
from collections.abc import Sequence
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
