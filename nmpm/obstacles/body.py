"""What a body is, and the checks and lattices that bodies share."""

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


def lattice(side: Tensor, spacing: float) -> Tensor:
    """Places along a side, about `spacing` apart and half of that from its ends, counted from its middle."""
    number = count(float(side.detach()) / spacing, "side", side)
    return ((torch.arange(number, dtype=torch.float64) + 0.5) / number - 0.5) * side


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
    found = tensor(value)
    count(float(found.detach()), name, found)
    return found


def finite(name: str, value: Number | Point) -> Tensor:
    """A parameter in float64, with its gradient; ConfigError unless it is finite."""
    found = tensor(value)
    if not found.detach().isfinite().all():
        raise ConfigError(f"An obstacle's {name} = {found.tolist()} must be finite.")
    return found


def tensor(value: Number | Point) -> Tensor:
    """In float64 on the CPU, with gradients of what is a tensor."""
    if isinstance(value, Tensor):
        return value.cpu().double()
    if isinstance(value, Sequence):
        return torch.stack([tensor(each) for each in value])
    return torch.tensor(float(value), dtype=torch.float64)
