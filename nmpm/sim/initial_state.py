"""What a simulation starts from."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any, Self

from numpy.typing import NDArray

from nmpm.sim.arrays import Array


class Obstacle(abc.ABC):
    """A body within the box that does not move."""

    @abc.abstractmethod
    def distance(self, points: Array) -> Array:
        """(K,) signed distance of points (K, D) from the surface, negative inside."""

    @abc.abstractmethod
    def moved(self, shift: Array) -> Self:
        """The same body shifted by (D,), in length."""


@dataclass(frozen=True)
class InitialState:
    """Everything that a simulation needs beside its preset, for N particles in D dimensions.

    Material starts without strain: stress-free in the material point method, at rest density in SPH. A state taken
    from the middle of a trajectory therefore continues it without the pressure that it had there.

    Args:
        position: (N, D) in length.
        velocity: (N, D) in length per second.
        gravity: (D,) acceleration, in length per second squared; the preset's if None.
        counts: Particles of each of the preset's materials, which `position` holds one after the other; all are of
            the first if empty.
        obstacles: Of the kind that the preset itself draws.
    """

    position: NDArray[Any]
    velocity: NDArray[Any]
    gravity: tuple[float, ...] | None = None
    counts: tuple[int, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
