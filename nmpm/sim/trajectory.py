"""What simulators return."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Progress = Callable[[int], object]
"""Called after each frame with the number of frames done."""


@dataclass(frozen=True)
class SimulatedTrajectory:
    """T frames of N particles, made by a reference simulator.

    Args:
        position: (T, N, D) float32, in length; the first frame is the initial state. Static particles are in every
            frame.
        particle_type: (N,) int64, DeepMind's type ids.
        attributes: The seed, gravity (D,) where it varies, and the simulator's counts of events that should not
            happen.
    """

    position: NDArray[np.float32]
    particle_type: NDArray[np.int64]
    attributes: dict[str, Any]
