"""Gravity that points another way in each trajectory."""

from __future__ import annotations

import math

import numpy as np


def turned(gravity: tuple[float, ...], most: float, rng: np.random.Generator) -> tuple[float, ...]:
    """A gravity of two axes, turned by an angle drawn between -most and most degrees; unchanged for most = 0."""
    if not most:
        return gravity
    angle = math.radians(rng.uniform(-most, most))
    (x, y), cos, sin = gravity, math.cos(angle), math.sin(angle)
    return cos * x - sin * y, sin * x + cos * y
