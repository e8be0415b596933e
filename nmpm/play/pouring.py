"""A jet: rows of particles, one behind the other, as fast as it flows."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nmpm.play.commands import Pour
from nmpm.play.placing import row

_ROWS = 2
"""Of particles that are poured at once: each time costs a call."""
_SLOWEST = 0.5
"""A slow jet flows as if by this share of a particle's spacing in a frame."""


class Jet:
    """What is poured now, `pour`; None for nothing.

    Args:
        spacing: Between particles, in domain length.
        dt: Time between frames, in seconds.
    """

    def __init__(self, spacing: float, dt: float) -> None:
        self._spacing, self._dt, self._flown = spacing, dt, 0.0
        self.pour: Pour | None = None

    def turn(self, pour: Pour | None) -> None:
        """Pour, elsewhere, or no longer; the first rows come at once."""
        if pour is None or self.pour is None:
            self._flown = math.inf
        self.pour = pour

    def rows(self, pour: Pour) -> Tensor | None:
        """(N, D) particles for the next frame; None until the last ones have made room."""
        speed = math.hypot(*pour.velocity)
        self._flown += max(speed * self._dt, _SLOWEST * self._spacing)
        if self._flown < _ROWS * self._spacing:
            return None
        self._flown = 0.0
        steps = [number * self._spacing / speed for number in range(_ROWS)]
        centres = [[x + step * v for x, v in zip(pour.at, pour.velocity, strict=True)] for step in steps]
        return torch.cat([row(centre, pour.velocity, pour.width, self._spacing) for centre in centres])
