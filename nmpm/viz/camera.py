"""How positions come to the picture plane: as they are in 2-D, by an orthographic camera in 3-D."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.viz.exhibit import Exhibit, Floats

AZIMUTH = math.radians(28)
ELEVATION = math.radians(22)
MARGIN = 0.008
"""Empty rim around the box, as a share of its longer side."""


@dataclass(frozen=True, eq=False)
class Camera:
    """An orthographic projection.

    Args:
        axes: (3, D) unit vectors to the picture's right, its top and the viewer; the last is zero in 2-D.
        low: (3,) lower corner of the window and farthest depth, along those axes.
        high: (3,) upper corner of the window and nearest depth.
    """

    axes: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def width(self) -> float:
        """Width of the window in domain length."""
        return float(self.high[0] - self.low[0])

    @property
    def height(self) -> float:
        """Height of the window in domain length."""
        return float(self.high[1] - self.low[1])

    @property
    def deep(self) -> bool:
        """Whether some particles are nearer to the viewer than others."""
        return bool(self.high[2] > self.low[2])

    def project(self, points: Floats) -> NDArray[np.float64]:
        """Points (..., D) as (..., 3): distance from the window's left and lower edge, and nearness in [0, 1]."""
        seen = points @ self.axes.T - self.low
        if self.deep:
            seen[..., 2] = np.clip(seen[..., 2] / (self.high[2] - self.low[2]), 0, 1)
        return np.asarray(seen, dtype=np.float64)


def camera_for(exhibit: Exhibit) -> Camera:
    """A camera that sees the whole box: straight on in 2-D, from one side and a little above in 3-D."""
    axes = np.eye(3, 2) if exhibit.dim == 2 else _oblique(np.eye(3)[upright_axis(exhibit)])
    corners = box_corners(exhibit.walls) @ axes.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    rim = np.array([1.0, 1.0, 0.0]) * MARGIN * (high - low).max()
    return Camera(axes, low - rim, high + rim)


def box_corners(box: tuple[tuple[float, float], ...]) -> NDArray[Any]:
    """The 2 ** D corners of a box, (2 ** D, D), the last axis running fastest."""
    return np.array(list(itertools.product(*box)), dtype=np.float64)


def upright_axis(exhibit: Exhibit) -> int:
    """The axis drawn upright: y in 2-D; in 3-D the one along gravity, y where gravity is unknown or zero."""
    pull = np.abs(exhibit.gravity) if exhibit.gravity else np.zeros(exhibit.dim)
    return int(np.argmax(pull)) if exhibit.dim == 3 and pull.any() else 1


def _oblique(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Right-handed view axes: turned about the upright axis, then tilted down."""
    side = np.eye(3)[int(np.argmin(np.abs(up)))]
    front = np.cross(side, up)
    right = math.cos(AZIMUTH) * side + math.sin(AZIMUTH) * front
    level = np.cross(right, up)
    toward = math.cos(ELEVATION) * level + math.sin(ELEVATION) * up
    return np.stack([right, np.cross(toward, right), toward])
