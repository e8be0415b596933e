"""Presets: a family of simulated scenes, its solver and initial states included, read from one YAML file."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from nmpm._support.bounded_files import FILE_NAME
from nmpm._support.messages import one_line
from nmpm._support.plain_data import to_plain
from nmpm.errors import ConfigError
from nmpm.scene import Interval, Scene
from nmpm.sim.state import InitialState, Progress, SimulatedTrajectory, check

BOUNDARY = 3
"""Type id of particles that never move, as in DeepMind's scenes."""


@dataclass(frozen=True)
class Preset(abc.ABC):
    """A family of simulated scenes; each solver has a subclass with its own parameters.

    Args:
        name: Of the family.
        frames: Simulated frames of a trajectory after its initial state.
        frame_dt: Time between frames, in seconds.
        substeps: Substeps of a frame.
        box: Where particles may be, (lower, upper) along each axis, in length.
        domain: What an emulator's grid covers, likewise.

    Raises:
        ConfigError: if a number is out of range.
    """

    solver: ClassVar[str]
    """Its name in a preset's file."""

    generator: ClassVar[str]
    """Name of the method, written to datasets."""

    revision: ClassVar[int]
    """Increased whenever the same preset and seed give other numbers."""

    name: str
    frames: int
    frame_dt: float
    substeps: int
    box: tuple[Interval, ...]
    domain: tuple[Interval, ...]

    def __post_init__(self) -> None:
        check(
            FILE_NAME.fullmatch(self.name) is not None,
            f"name = {one_line(repr(self.name), 80)} names files and folders: give letters, digits, - _ and ., the"
            " first a letter or digit.",
        )
        self._check_positive("frames", "frame_dt", "substeps")
        self._check_whole("frames", "substeps")

    def _check_whole(self, *keys: str) -> None:
        for key in keys:
            check(isinstance(getattr(self, key), int), f"{key} = {getattr(self, key)} must be a whole number.")

    def _check_positive(self, *keys: str) -> None:
        for key in keys:
            value = getattr(self, key)
            check(
                isinstance(value, int | float) and 0 < value < math.inf, f"{key} = {value} must be positive and finite."
            )

    @abc.abstractmethod
    def draw(self, seed: int) -> InitialState:
        """The initial state of a seed's trajectory.

        Raises:
            ConfigError: if no arrangement fits into the box.
        """

    @abc.abstractmethod
    def simulate_from(self, start: InitialState, frames: int, progress: Progress | None = None) -> SimulatedTrajectory:
        """A trajectory of `frames` + 1 frames, the first of which is the given state.

        The preset's own initial states and number of frames are not used.

        Args:
            start: Within the box and outside of obstacles.
            frames: Frames to simulate.
            progress: Called after each frame.

        Raises:
            DataError: if the arrays do not fit together, there is no particle, or one is outside of the box or inside
                an obstacle.
            UnstableError: if the simulation becomes unstable; the message names the frame.
        """

    def simulate(self, seed: int, progress: Progress | None = None) -> SimulatedTrajectory:
        """A trajectory of `self.frames` + 1 frames; the same preset and seed give the same bits.

        Raises:
            ConfigError: if no initial state fits into the box.
            UnstableError: if the simulation becomes unstable.
        """
        try:
            trajectory = self.simulate_from(self.draw(seed), self.frames, progress)
        except ConfigError as error:
            raise type(error)(f"Preset {self.name}, seed {seed}: {error}") from error
        trajectory.attributes["seed"] = seed
        return trajectory

    @property
    @abc.abstractmethod
    def scene(self) -> Scene:
        """What the preset's trajectories have in common, known without simulating."""

    @property
    @abc.abstractmethod
    def type_names(self) -> dict[int, str]:
        """Name of each particle type id that the trajectories may hold."""

    @property
    @abc.abstractmethod
    def max_particles(self) -> int:
        """Upper bound of a trajectory's particles, static ones included."""

    @property
    @abc.abstractmethod
    def stable_substeps(self) -> int:
        """Fewest substeps of a frame with which the preset's scenes are stable."""

    @abc.abstractmethod
    def varied(self, *, speed: float = 1.0, gravity: float = 1.0) -> Self:
        """The same scenes with initial speeds and gravity times a factor; with more substeps where stability asks it.

        A negative factor reverses gravity.
        """

    @abc.abstractmethod
    def widened(self, times: int) -> Self:
        """Scenes in a domain so many times as wide, with up to as many times as many particles."""

    @abc.abstractmethod
    def coarsened(self, factor: int) -> Self:
        """A cheaper simulation, `factor` times as coarse, with `stable_substeps` substeps.

        Raises:
            ConfigError: if the preset's resolution cannot be divided so.
        """

    def _widened_sides(self, times: int, step: float) -> tuple[Interval, Interval, int]:
        """Box and domain along x in a domain so many times as wide, and how many steps of a length fill that box.

        The box is as wide as whole steps allow, its wall layer on the right at least what it was.
        """
        (left, right), (low, high) = self.domain[0], self.box[0]
        edge = left + times * (right - left)
        steps = math.floor((edge - (right - high) - low) / step + 1e-9)
        return (low, low + steps * step), (left, edge), steps

    def with_frames(self, frames: int) -> Self:
        """The same with another number of frames.

        Raises:
            ConfigError: if it is not a positive whole number.
        """
        return dataclasses.replace(self, frames=frames)

    def to_dict(self) -> dict[str, Any]:
        """The preset as plain lists, strings and numbers, laid out as in its file."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {"solver": self.solver} | {key: to_plain(value) for key, value in values.items() if value is not None}

    @classmethod
    @abc.abstractmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """The preset that `to_dict` described.

        Raises:
            ConfigError: if a key is unknown, missing or of the wrong kind.
        """
