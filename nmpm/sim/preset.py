"""Presets: everything that a simulated family of scenes is made of, read from one YAML file."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Self

from nmpm._support.plain_data import to_lists, to_tuples
from nmpm.errors import ConfigError
from nmpm.scene import Scene
from nmpm.sim.trajectory import Progress, SimulatedTrajectory

BOUNDARY = 3
"""Type number of particles that never move, after DeepMind's scenes."""


class Preset(abc.ABC):
    """A family of simulated scenes; below it, one frozen dataclass per solver.

    Attributes:
        name: Of the family.
        frames: Simulated frames of a trajectory after its initial state.
        frame_dt: Time between frames, in seconds.
    """

    solver: ClassVar[str]
    """By which a preset's file asks for it."""

    generator: ClassVar[str]
    """Name of the method, for the files' provenance."""

    revision: ClassVar[int]
    """Raised whenever the same preset and seed would give other numbers."""

    name: str
    frames: int
    frame_dt: float

    @abc.abstractmethod
    def simulate(self, seed: int, progress: Progress | None = None) -> SimulatedTrajectory:
        """A trajectory of `frames` + 1 frames, the same to the bit for the same preset and seed.

        Raises:
            ConfigError: if no initial state is found, or the state is no longer finite.
        """

    @property
    @abc.abstractmethod
    def scene(self) -> Scene:
        """The facts that the preset's trajectories share, without simulating one."""

    @property
    @abc.abstractmethod
    def type_names(self) -> dict[int, str]:
        """Name of each particle type id that the trajectories may hold."""

    @property
    @abc.abstractmethod
    def most_particles(self) -> int:
        """A trajectory has no more particles than that, static ones included."""

    def lasting(self, frames: int) -> Self:
        """The same, with another number of frames.

        Raises:
            ConfigError: if it is not a positive whole number.
        """
        changed: Self = dataclasses.replace(self, frames=frames)  # type: ignore[type-var]  # (every preset is one)
        return changed

    def to_dict(self) -> dict[str, Any]:
        """The preset as plain lists, strings and numbers, laid out as in its file."""
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}  # type: ignore[arg-type]  # (likewise)
        return {"solver": self.solver} | {key: _plain(value) for key, value in own.items() if value is not None}

    @classmethod
    @abc.abstractmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """The preset that `to_dict` described.

        Raises:
            ConfigError: if a key is unknown, missing or of the wrong kind.
        """


def checked(kind: type[Any], plain: Any, where: str) -> dict[str, Any]:
    """The entries of a section, if they are the fields of a dataclass; those with defaults may be missing.

    Raises:
        ConfigError: naming the keys that are unknown or missing.
    """
    if not isinstance(plain, Mapping):
        raise ConfigError(f"{where} must map keys to values; it is {plain!r}.")
    fields = {field.name: field for field in dataclasses.fields(kind)}
    needed = {name for name, field in fields.items() if _is_required(field)}
    for problem, keys in (("unknown", set(plain) - set(fields)), ("missing", needed - set(plain))):
        if keys:
            raise ConfigError(
                f"{where}: {problem} {', '.join(sorted(map(str, keys)))}; keys: {', '.join(sorted(fields))}."
            )
    return dict(plain)


def built(kind: type[Any], plain: Any, where: str) -> Any:
    """A dataclass from a section's entries, with lists as tuples.

    Raises:
        ConfigError: if a key is unknown or missing, or a value is wrong.
    """
    entries = {key: to_tuples(value) for key, value in checked(kind, plain, where).items()}
    try:
        return kind(**entries)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from error


def require(holds: bool, message: str) -> None:
    """Raises a ConfigError with the message unless the condition holds."""
    if not holds:
        raise ConfigError(message)


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return to_lists(value)
