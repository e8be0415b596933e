"""Projection of positions onto the picture plane: unchanged in 2-D, orthographic in 3-D."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.viz.trajectories import Floats, LabelledTrajectories

AZIMUTH = math.radians(28)
ELEVATION = math.radians(22)
MARGIN = 0.008
"""Empty margin around the box, as a fraction of its longer side."""


@dataclass(frozen=True, eq=False)
class Camera:
    """An orthographic projection.

    Args:
        axes: (3, D) unit vectors to the right, up and toward the viewer; the last is zero in 2-D.
        low: (3,) left and lower edge of the window and largest depth, along those axes.
        high: (3,) right and upper edge of the window and smallest depth.
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
    def has_depth(self) -> bool:
        """Whether distances to the viewer differ: True in 3-D, False in 2-D."""
        return bool(self.high[2] > self.low[2])

    def project(self, points: Floats) -> NDArray[np.float64]:
        """Projects points (..., D) to (..., 3): distance from the window's left and lower edge, nearness in [0, 1]."""
        projected = points @ self.axes.T - self.low
        if self.has_depth:
            projected[..., 2] = np.clip(projected[..., 2] / (self.high[2] - self.low[2]), 0, 1)
        return np.asarray(projected, dtype=np.float64)


def fit_camera(trajectories: LabelledTrajectories) -> Camera:
    """Returns a camera that shows the whole box: from the front in 2-D, obliquely from above in 3-D."""
    axes = np.eye(3, 2) if trajectories.dim == 2 else _oblique_axes(np.eye(3)[vertical_axis(trajectories)])
    corners = box_corners(trajectories.outer_bounds) @ axes.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = np.array([1.0, 1.0, 0.0]) * MARGIN * (high - low).max()
    return Camera(axes, low - margin, high + margin)


def box_corners(box: tuple[tuple[float, float], ...]) -> NDArray[Any]:
    """The 2 ** D corners of a box, (2 ** D, D), the last axis varying fastest."""
    return np.array(list(itertools.product(*box)), dtype=np.float64)


def vertical_axis(trajectories: LabelledTrajectories) -> int:
    """Index of the axis drawn vertically: y in 2-D; in 3-D that of gravity, or y if gravity is unknown or zero."""
    strength = np.abs(trajectories.gravity) if trajectories.gravity else np.zeros(trajectories.dim)
    return int(np.argmax(strength)) if trajectories.dim == 3 and strength.any() else 1


def _oblique_axes(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Right-handed view axes: rotated about the vertical axis by AZIMUTH, then tilted down by ELEVATION."""
    side = np.eye(3)[int(np.argmin(np.abs(up)))]
    front = np.cross(side, up)
    right = math.cos(AZIMUTH) * side + math.sin(AZIMUTH) * front
    level = np.cross(right, up)
    toward = math.cos(ELEVATION) * level + math.sin(ELEVATION) * up
    return np.stack([right, np.cross(toward, right), toward])
