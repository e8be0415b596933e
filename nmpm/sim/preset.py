"""Presets: a family of simulated scenes, its solver and initial states included, read from one YAML file."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, ClassVar, Self

import numpy as np

from nmpm._support.bounded_files import FILE_NAME
from nmpm._support.messages import one_line
from nmpm._support.plain_data import check_whole, from_plain, to_plain
from nmpm.errors import ConfigError
from nmpm.scene import Interval, Scene
from nmpm.sim.state import Array, InitialState, Layout, Obstacle, Progress, SimulatedTrajectory, check, check_numbers

BOUNDARY = 3
"""Type id of particles that never move, as in DeepMind's scenes."""


@dataclass(frozen=True, kw_only=True)
class Preset(abc.ABC):
    """A family of simulated scenes; each solver has a subclass with its own parameters.

    Args:
        name: Of the family.
        frames: Simulated frames of a trajectory after its initial state.
        frame_dt: Time between frames, in seconds.
        substeps: Substeps of a frame.
        box: Where material is put, (lower, upper) along each axis, in length.
        domain: What an emulator's grid covers, likewise.
        spacing: Distance between particles at rest, in length.
        gravity: Acceleration, in length per second squared.
        gravity_turn: Largest angle by which a trajectory's gravity is turned either way, in degrees; in 2-D only.

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
    spacing: float
    gravity: tuple[float, ...]
    gravity_turn: float = 0.0

    def __post_init__(self) -> None:
        check(
            FILE_NAME.fullmatch(self.name) is not None,
            f"name = {one_line(repr(self.name), 80)} names files and folders: give letters, digits, - _ and ., the"
            " first a letter or digit.",
        )
        check_numbers(self, "", positive=("frames", "frame_dt", "substeps", "spacing"))
        check(all(low < high for low, high in self.box), f"box = {self.box} needs (lower, upper) along each axis.")
        check(0 <= self.gravity_turn <= 180, f"gravity_turn = {self.gravity_turn} must be within 0 and 180 degrees.")

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

    def stream_from(self, start: InitialState) -> Iterator[Array]:  # noqa: ARG002
        """Yield the positions (N, D) of what moves, frame after frame without end; each is overwritten by the next.

        Raises:
            ConfigError: if this solver cannot be followed so.
            DataError, UnstableError: as `simulate_from`.
        """
        raise ConfigError(f"The preset {self.name} simulates whole trajectories alone.")

    def obstacles_from(self, particles: Array) -> tuple[Obstacle, ...]:
        """The obstacles that particles (M, D) which do not move fill, as trajectories hold them; the box has its walls.

        Raises:
            ConfigError: if there are some within the box that cannot be told from their particles.
        """
        low, high = np.array(self.box).T
        inside = ((particles > low) & (particles < high)).all(axis=1)
        if inside.any():
            raise ConfigError(
                f"The preset {self.name} cannot tell obstacles from their {int(inside.sum())} particles in the box, the"
                f" first at {particles[inside][0].round(3).tolist()}; it goes on from scenes without obstacles alone."
            )
        return ()

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
    def scene(self) -> Scene:
        """The facts that all trajectories share, known without simulating."""
        return Scene(
            bounds=self.reach,
            domain=self.domain,
            dt=self.frame_dt,
            materials=tuple(name for number, name in self.type_names.items() if number != BOUNDARY),
            particle_volume=self.spacing ** len(self.box),
            gravity=None if self.gravity_turn else self.gravity,
            gravity_varies=self.gravity_turn > 0,
            obstacles=BOUNDARY in self.type_names,
        )

    @property
    def reach(self) -> tuple[Interval, ...]:
        """How far particles can get, (lower, upper) along each axis."""
        return self.box

    @property
    @abc.abstractmethod
    def type_names(self) -> dict[int, str]:
        """Name of each particle type id that the trajectories may hold, materials in their order."""

    @property
    @abc.abstractmethod
    def max_particles(self) -> int:
        """Upper bound of a trajectory's particles, static ones included."""

    @property
    @abc.abstractmethod
    def stable_substeps(self) -> int:
        """Fewest substeps of a frame with which the preset's scenes are stable."""

    @property
    @abc.abstractmethod
    def _layouts(self) -> Mapping[str, Layout]:
        """How the initial state is drawn, by the name of its field."""

    def varied(self, *, speed: float = 1.0, gravity: float = 1.0) -> Self:
        """The same scenes with initial speeds and gravity times a factor; with more substeps where stability asks it.

        A negative factor reverses gravity. SPH's speed of sound stays, so that flows which come near it fail as
        unstable.
        """
        layouts = {key: layout.faster(speed) for key, layout in self._layouts.items()}
        return self._with_stable_substeps(
            self.substeps, gravity=tuple(gravity * pull for pull in self.gravity), **layouts
        )

    @abc.abstractmethod
    def widened(self, times: int) -> Self:
        """Scenes in a domain so many times as wide, with up to as many times as many particles."""

    @abc.abstractmethod
    def coarsened(self, factor: int) -> Self:
        """A cheaper simulation, `factor` times as coarse, with `stable_substeps` substeps.

        Raises:
            ConfigError: if the preset's resolution cannot be divided so.
        """

    def _with_stable_substeps(self, least: int, **changes: Any) -> Self:
        """The same but for changes, with `stable_substeps`, or `least` if that is more."""
        many = dataclasses.replace(self, substeps=2**31, **changes)  # accepted whatever the cells and speeds
        return dataclasses.replace(many, substeps=max(least, many.stable_substeps))

    def _widened_sides(self, times: int, step: float) -> tuple[tuple[Interval, ...], tuple[Interval, ...], int]:
        """Box and domain so many times as wide along x, and how many steps of a length fill that box.

        The box is as wide as whole steps allow, its wall layer on the right at least what it was.
        """
        (left, right), (low, high) = self.domain[0], self.box[0]
        edge = left + times * (right - left)
        steps = math.floor((edge - (right - high) - low) / step + 1e-9)
        return ((low, low + steps * step), *self.box[1:]), ((left, edge), *self.domain[1:]), steps

    def _draw_gravity(self, rng: np.random.Generator) -> tuple[float, ...]:
        """Gravity, turned by a random angle of at most `gravity_turn`."""
        if not self.gravity_turn:
            return self.gravity
        angle = math.radians(rng.uniform(-self.gravity_turn, self.gravity_turn))
        (x, y), cos, sin = self.gravity, math.cos(angle), math.sin(angle)
        return cos * x - sin * y, sin * x + cos * y

    def with_frames(self, frames: int) -> Self:
        """The same with another number of frames; ConfigError if it is not a positive whole number."""
        return dataclasses.replace(self, frames=check_whole("frames", frames, 1))

    def with_stride(self, stride: Fraction) -> Self:
        """The same scenes with `stride` of these frames as one, as long in time and with substeps no longer."""
        frames, least = max(1, round(self.frames / stride)), math.ceil(self.substeps * stride)
        return self._with_stable_substeps(least, frames=frames, frame_dt=float(self.frame_dt * stride))

    def to_dict(self) -> dict[str, Any]:
        """The preset as plain lists, strings and numbers, laid out as in its file."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {"solver": self.solver} | {key: to_plain(value) for key, value in values.items() if value is not None}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """The preset that `to_dict` described.

        Raises:
            ConfigError: if a key is unknown, missing or of the wrong kind.
        """
        return from_plain(cls, plain, "the preset")


def twin_of(preset: Preset) -> Preset:
    """The twin: the simulator with half as many substeps; with the fewest that the solver accepts if that is more.

    Where it accepts no fewer, with twice as many. The distance of the two estimates the simulator's own error.
    """
    for substeps in (-(-preset.substeps // 2), preset.stable_substeps):
        if substeps < preset.substeps:
            with suppress(ConfigError):
                return dataclasses.replace(preset, substeps=substeps)
    return dataclasses.replace(preset, substeps=2 * preset.substeps)


def nudge(preset: Preset, start: InitialState, share: float, seed: int) -> InitialState:
    """The state with Gaussian noise on its positions, which stay within the box.

    Args:
        preset: Gives domain and box.
        start: Of the preset.
        share: Standard deviation of the noise, as a share of the domain's longest side.
        seed: Of the noise.
    """
    side = max(high - low for low, high in preset.domain)
    noise = share * side * np.random.default_rng(seed).standard_normal(start.position.shape)
    low, high = np.array(preset.box).T
    low, high = np.minimum(low, start.position.min(0)), np.maximum(high, start.position.max(0))
    return dataclasses.replace(start, position=np.clip(start.position + noise, low, high))
