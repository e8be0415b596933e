"""Which axes of foreign data are a model's: its gravity points along them as in the training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import permutations, product

import torch

from nmpm.emulator.calibration import channel_values
from nmpm.emulator.model import UNLIMITED, Emulator
from nmpm.scene import Scene, Turn

_STEADY = 0.1
"""Share of the strongest component of gravity below which the other components vary too little to tell directions."""


def find_turn(emulator: Emulator, scene: Scene) -> Turn:
    """The turn from the axes of a scene to those of a model's: that with gravity and boundaries like the model's.

    Of those that do equally well the one that moves fewest axes. Gravity counts where both have one direction.
    """
    usual, gravity, dim = _direction(emulator), scene.gravity, scene.dim
    gravity = gravity if usual and gravity and any(gravity) else None

    def misfit(turn: Turn) -> tuple[float, int, int, int]:
        along = cosine(usual, turn.vector(gravity)) if usual and gravity else 0.0
        boundary = zip(turn.permuted(scene.boundary), emulator.scene.boundary, strict=True)
        moved = sum(source != axis for axis, source in enumerate(turn.sources))
        return -round(along, 2), sum(one != other for one, other in boundary), sum(turn.mirrored), moved

    return min((Turn(axes) for axes in _turns(dim)), key=misfit)


def describe_turn(turn: Turn) -> str:
    """Which axis of the data is which of the model, of those that differ."""
    differing = [(one, other) for one, other in zip(turn.axes, "xyz", strict=False) if one != other]
    return ", ".join(f"{one} of the data is {other} of the model" for one, other in differing)


def _turns(dim: int) -> list[tuple[str, ...]]:
    orders = permutations("xyz"[:dim])
    return [
        tuple(map("".join, zip(signs, order, strict=True)))
        for order in orders
        for signs in product(("", "-"), repeat=dim)
    ]


def _direction(emulator: Emulator) -> Sequence[float] | None:
    """A vector along the gravity of a model's training; None without any, or where its direction varied."""
    if not emulator.scene.gravity_varies:
        gravity = emulator.scene.gravity
        return gravity if gravity and any(gravity) else None
    if not emulator.calibrated:
        return None
    mean, std, high = (
        channel_values(emulator, each, "gravity_")
        for each in (emulator.input_mean, emulator.input_std, emulator.input_high)
    )
    std = torch.where(high < UNLIMITED / 2, std, 0.0)  # those of a component that never varied say nothing
    size = (mean.square() + std.square()).sqrt()
    strongest = int(size.argmax())
    others = [float(value) for axis, value in enumerate(size) if axis != strongest]
    one_way = float(mean[strongest].abs()) > float(std[strongest])
    if not one_way or max(others, default=0.0) > _STEADY * float(size[strongest]):
        return None
    return [float(mean[axis]) if axis == strongest else 0.0 for axis in range(len(size))]


def cosine(one: Sequence[float], other: Sequence[float]) -> float:
    """The cosine of the angle between two vectors."""
    return sum(a * b for a, b in zip(one, other, strict=True)) / (math.hypot(*one) * math.hypot(*other))
