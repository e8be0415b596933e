"""How fast the particles of a dataset move."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Motion:
    """How a dataset's particles move, as measured in some of its trajectories.

    Args:
        rms: Root mean square of their speeds, in length per frame of the dataset.
        largest: Speed that all but the fastest 0.1% stay below, likewise.
        gravity: As measured in free flight where the scene states none, in length per second squared; where gravity
            varies, the root mean square of each component over the trajectories. None where it is unknown.
    """

    rms: float
    largest: float
    gravity: tuple[float, ...] | None = None
