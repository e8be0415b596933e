"""Gravity whose direction differs between trajectories."""

from __future__ import annotations

import math

import numpy as np


def draw_gravity(gravity: tuple[float, ...], max_turn: float, rng: np.random.Generator) -> tuple[float, ...]:
    """A gravity of two axes, turned by a random angle of at most `max_turn` degrees; unchanged for 0."""
    if not max_turn:
        return gravity
    angle = math.radians(rng.uniform(-max_turn, max_turn))
    (x, y), cos, sin = gravity, math.cos(angle), math.sin(angle)
    return cos * x - sin * y, sin * x + cos * y
