"""Initial states and how they are drawn, simulated trajectories, and the loop over frames that all solvers share."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import ConfigError, DataError
from nmpm.scene import Interval

Array = NDArray[np.float64]
"""The array type of the simulators."""

Progress = Callable[[int], object]
"""Called after each frame with the number of frames done."""


def check(condition: bool, message: str) -> None:
    """Raise a ConfigError with the message unless the condition holds."""
    if not condition:
        raise ConfigError(message)


def check_numbers(
    owner: object, section: str, *, positive: tuple[str, ...] = (), at_least_0: tuple[str, ...] = ()
) -> None:
    """Check that attributes, numbers or ranges (lower, upper) of them, are positive or at least 0, and finite.

    Raises:
        ConfigError: naming `section` and the attribute.
    """
    for key in (*positive, *at_least_0):
        value = getattr(owner, key)
        low, high = value if isinstance(value, tuple) else (value, value)
        kind, enough = ("positive", low > 0) if key in positive else ("at least 0", low >= 0)
        order = ", the lower number first" if isinstance(value, tuple) else ""
        check(enough and low <= high < math.inf, f"{section}{key} = {value} must be {kind} and finite{order}.")


class Obstacle(abc.ABC):
    """A body within the box that does not move."""

    @abc.abstractmethod
    def distance(self, points: Array) -> Array:
        """(K,) signed distance of points (K, D) from the surface, negative inside."""

    @abc.abstractmethod
    def moved(self, shift: Array) -> Self:
        """The same body shifted by (D,), in length."""


AnyObstacle = TypeVar("AnyObstacle", bound=Obstacle)


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

    def check_particles(self, reach: tuple[Interval, ...], obstacles: tuple[Obstacle, ...] = ()) -> None:
        """Raise a DataError unless there are particles, finite, within `reach` and in no obstacle."""
        position, velocity = self.position, self.velocity
        if position.ndim != 2 or position.shape[1] != len(reach) or velocity.shape != position.shape:
            raise DataError(
                f"Positions {position.shape} and velocities {velocity.shape} must both have shape (N, {len(reach)})."
            )
        if not len(position):
            raise DataError("There is no particle to simulate: give the position of one at least.")
        low, high = np.array(reach).T
        valid = np.all((low <= position) & (position <= high) & np.isfinite(velocity), axis=1)
        for obstacle in obstacles:
            valid[valid] &= obstacle.distance(position[valid]) >= 0
        if not valid.all():
            worst = int(np.argmin(valid))
            raise DataError(
                f"Particle {worst} at {position[worst].tolist()} with velocity {velocity[worst].tolist()} is not"
                f" finite, not within {reach} or in an obstacle."
            )

    def counts_of(self, materials: int) -> tuple[int, ...]:
        """Particles of each material; raises a DataError unless they add up to all."""
        count = len(self.position)
        counts = self.counts or (count,) + (0,) * (materials - 1)
        if len(counts) != materials or sum(counts) != count:
            raise DataError(f"Counts {counts} do not divide {count} particles among {materials} materials.")
        return counts

    def obstacles_of(self, kind: type[AnyObstacle]) -> tuple[AnyObstacle, ...]:
        """The obstacles; raises a DataError unless all are of the kind that a solver simulates."""
        obstacles = tuple(obstacle for obstacle in self.obstacles if isinstance(obstacle, kind))
        if len(obstacles) != len(self.obstacles):
            raise DataError(f"This solver simulates a {kind.__name__}; other obstacles are not implemented.")
        return obstacles


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


def record_frames(
    first: Array, static: Array, frames: int, advance: Callable[[int], Array], progress: Progress | None
) -> NDArray[np.float32]:
    """(frames + 1, N + M, D) positions, those of static particles (M, D) after those of moving ones.

    `advance` simulates the frame of an index, from 1, and returns its positions (N, D).
    """
    moving, dim = first.shape
    recorded = np.empty((frames + 1, moving + len(static), dim), np.float32)
    recorded[0, :moving], recorded[:, moving:] = first, static
    for frame in range(1, frames + 1):
        recorded[frame, :moving] = advance(frame)
        if progress is not None:
            progress(frame)
    return recorded


class Layout(abc.ABC):
    """How the initial state is drawn."""

    @abc.abstractmethod
    def faster(self, factor: float) -> Self:
        """The same at initial speeds times a factor."""

    @abc.abstractmethod
    def multiplied(self, times: int) -> Self:
        """For a box so many times as wide: up to as many times as many particles."""


@dataclass(frozen=True)
class BlockRanges(Layout):
    """How blocks are drawn; lengths in metres.

    Args:
        number: Least and most blocks in a scene.
        particles: Least and most particles in a scene, all blocks together.
        share: Least part of the particles in one block.
        aspect: Least and largest height over width.
        gap: Least distance between blocks, and from the box's sides.
        speed: Largest initial velocity along each axis, in length per second.
        jitter: Largest displacement of a particle off the lattice along each axis, in spacings.
    """

    number: tuple[int, int]
    particles: tuple[int, int]
    share: float
    aspect: tuple[float, float]
    gap: float
    speed: float
    jitter: float

    def __post_init__(self) -> None:
        check_numbers(
            self, "blocks.", positive=("number", "particles", "share", "aspect"), at_least_0=("gap", "speed", "jitter")
        )
        check(self.share * self.number[1] <= 1, f"blocks.share = {self.share} is too large for the blocks.")
        check(self.jitter < 0.5, f"blocks.jitter = {self.jitter} must be below 0.5.")

    def faster(self, factor: float) -> Self:
        return dataclasses.replace(self, speed=factor * self.speed)

    def multiplied(self, times: int) -> Self:
        return dataclasses.replace(
            self,
            particles=(self.particles[0], times * self.particles[1]),
            number=(self.number[0], times * self.number[1]),
            share=self.share / times,
        )


def lattice(low: Array, shape: tuple[int, ...], spacing: float, shift: Array | float = 0.0) -> Array:
    """(N, D) centres of the cells of a lattice, moved by `shift` (N, D) spacings; the last axis varies fastest."""
    nodes = np.stack(np.meshgrid(*(np.arange(number) for number in shape), indexing="ij"), axis=-1)
    return np.asarray(low + spacing * (nodes.reshape(-1, len(shape)) + 0.5 + shift))
