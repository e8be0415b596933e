"""The gravity of single trajectories, where the scenes of a dataset differ in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from nmpm._support.messages import one_line
from nmpm.errors import DataError
from nmpm.scene import Scene


def own_gravity(attributes: Mapping[str, Any], scene: Scene, where: str) -> tuple[float, ...] | None:
    """The gravity (D,) that a trajectory's attributes state, else its scene's, in length/s²; None if neither does.

    Args:
        attributes: Of the trajectory.
        scene: Of the trajectory.
        where: The trajectory, for messages.

    Raises:
        DataError: if the attribute is not a finite number for each axis.
    """
    own = attributes.get("gravity")
    if own is None:
        return scene.gravity
    try:
        stated = np.asarray(own, dtype=np.float64)
    except (TypeError, ValueError):
        stated = np.empty(0)
    if stated.shape != (scene.dim,) or not np.isfinite(stated).all():
        raise DataError(f"{where}: the attribute gravity = {one_line(own, 60)} should be {scene.dim} finite numbers.")
    return tuple(stated.tolist())
