"""What simulators give back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Progress = Callable[[int], None]
"""Told how many frames are done, after each."""


@dataclass(frozen=True)
class SimulatedTrajectory:
    """T frames of N particles, made by a reference simulator.

    Args:
        position: (T, N, D) float32, in length; the first frame is the initial state. Static particles stand in every
            frame.
        particle_type: (N,) int64, DeepMind's numbers.
        attributes: What else is known: the seed, gravity (D,) where it varies, the simulator's counts of what should
            not happen.
    """

    position: NDArray[np.float32]
    particle_type: NDArray[np.int64]
    attributes: dict[str, Any]
