"""Facts that a user states of data: one table of their names, forms and checks, and what they change in the metadata.

The options of commands (`nmpm.cli.options.FactOptions`), the keys under `data` of configurations, the keyword arguments
of `nmpm.load_trajectories`, and the words by which one command names another, are the fields of `Options`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self, get_args

from nmpm._support.messages import suggestion
from nmpm.data.families import STATIC_NAMES, find_family
from nmpm.errors import ConfigError
from nmpm.scene import Boundary, Interval, check_field_names

if TYPE_CHECKING:
    from nmpm.data.metadata import Metadata

AXES = "axes"
"""Key of `metadata.json`: the order of the axes of positions, where a user states it."""


@dataclass(frozen=True)
class Text:
    """The form of a value in words of a command, such as 0,-9.81.

    Args:
        parse: Reads a text, or raises ValueError.
        expected: What to give, for messages.
        write: The text of a value.
    """

    parse: Callable[[str], Any]
    expected: str
    write: Callable[[Any], str] = str

    def read(self, option: str, text: str | None) -> Any:
        """The value of an option's text, None of None; raises ConfigError, saying what to give, if it is no such."""
        if text is None:
            return None
        try:
            return self.parse(text)
        except ValueError as error:
            raise ConfigError(f"{option} {text}: give {self.expected}.") from error

    __call__ = read


def _parts(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


def _named_type(text: str) -> tuple[int, str]:
    number, name = text.split("=")
    return int(number), name.strip()


def _interval(text: str) -> Interval:
    low, high = map(float, text.split(":"))
    if not low < high:
        raise ValueError(text)
    return low, high


_TYPES = Text(
    lambda text: dict(map(_named_type, _parts(text))),
    "ID=NAME pairs, e.g. 5=water,1=debris",
    lambda names: ",".join(f"{number}={name}" for number, name in names.items()),
)
_IDS = Text(
    lambda text: frozenset() if text == "none" else frozenset(map(int, _parts(text))),
    'type ids, e.g. 1,3, or "none"',
    lambda ids: ",".join(map(str, sorted(ids))) or "none",
)
_INTERVALS = Text(
    lambda text: tuple(map(_interval, _parts(text))),
    "LOW:HIGH for each axis, e.g. 0:1,0:0.5",
    lambda intervals: ",".join(f"{low:.12g}:{high:.12g}" for low, high in intervals),
)
_VECTOR = Text(
    lambda text: tuple(map(float, _parts(text))),
    "a number for each axis, e.g. 0,-9.81",
    lambda values: ",".join(f"{value:.12g}" for value in values),
)
_NAMES = Text(_parts, "names, e.g. temperature,stiffness", ",".join)
_PLAIN = Text(str, "a text")


def _fact(metavar: str | None = None, text: Text = _PLAIN, make: Callable[[Any], Any] | None = None) -> Any:
    """A field of `Options`: what stands for its value in the help, its form in words, and what plain values become."""
    return field(default=None, metadata={"metavar": metavar, "text": text, "make": make})


@dataclass(frozen=True)
class Options:
    """Facts that a user states where the files are silent or wrong; None takes what the files state.

    Args:
        family: Meaning of type ids: deepmind, lagrangebench or jax-sph.
        types: Names of particle types, e.g. 5=water,1=debris.
        static: Types that never move, e.g. 1,3; "none" where all move.
        prescribed: Obstacles that move as recorded, like a paddle, e.g. 2.
        bounds: Where particles may be, per axis, e.g. 0:1,0:0.5.
        dt: Time between stored frames, in the data's unit.
        gravity: Acceleration in length/time², e.g. 0,-9.81, or --gravity=-9.81,0.
        boundary: "wall", "periodic" or "open" per axis, e.g. periodic,wall.
        axes: Positions are frames, particles, axes, though their first two look swapped.
        files: Names of the files to read, e.g. 'Fluid_*.vtk', where others lie beside.
        fields: Fields that are inputs of models, e.g. temperature.
        resample: Interpolate to frames that are DT apart in time.
        smooth: Replace positions of measured tracks by local quadratic fits to so many frames, e.g. 5; errors are then
            against the smoothed tracks.

    Raises:
        ConfigError: for a value that is invalid for data of any kind, naming the fact.
    """

    title: ClassVar[str] = "facts that the files lack or state wrongly"
    """Heading of the help of commands."""

    family: str | None = None
    types: Mapping[int, str] | None = _fact("ID=NAME,...", _TYPES)
    static: frozenset[int] | None = _fact("ID,...", _IDS, frozenset)
    prescribed: frozenset[int] | None = _fact("ID,...", _IDS, frozenset)
    bounds: Sequence[Interval] | None = _fact(
        "LOW:HIGH,...", _INTERVALS, lambda ends: tuple((float(low), float(high)) for low, high in ends)
    )
    dt: float | None = None
    gravity: Sequence[float] | None = _fact("X,Y[,Z]", _VECTOR, lambda values: tuple(map(float, values)))
    boundary: Sequence[Boundary] | None = _fact("KIND,...", _NAMES, tuple)
    axes: str | None = _fact("TND")
    files: str | None = _fact("PATTERN,...")
    fields: Sequence[str] | None = _fact("NAME,...", _NAMES, tuple)
    resample: float | None = field(default=None, metadata={"metavar": "DT"})
    smooth: int | None = field(default=None, metadata={"metavar": "FRAMES"})

    def __post_init__(self) -> None:
        for one in fields(Options):
            make, value = one.metadata.get("make"), getattr(self, one.name)
            if make is not None and value is not None:
                try:
                    object.__setattr__(self, one.name, make(value))
                except (TypeError, ValueError) as error:
                    raise ConfigError(f"{one.name} = {value}: give {one.metadata['text'].expected}.") from error
        if self.family is not None:
            find_family(self.family)
        if self.boundary is not None and not set(self.boundary) <= set(get_args(Boundary)):
            raise ConfigError(f"boundary = {list(self.boundary)} must be {', '.join(get_args(Boundary))} per axis.")
        if self.axes not in (None, "TND"):
            raise ConfigError(f"axes = {self.axes}: positions are read as TND: frames, particles, axes. Swap others.")
        check_field_names(self.fields or ())
        if self.dt is not None and not self.dt > 0:
            raise ConfigError(f"dt = {self.dt} must be positive: seconds between stored frames.")
        if self.static and self.prescribed and self.static & self.prescribed:
            raise ConfigError(
                f"static = {sorted(self.static)} and prescribed = {sorted(self.prescribed)} share types: those"
                " that move as recorded are prescribed only."
            )
        if self.resample is not None and not 0 < self.resample < math.inf:
            raise ConfigError(f"resample = {self.resample} must be positive: the time between the new frames.")
        if self.smooth is not None and (self.smooth < 5 or self.smooth % 2 == 0):
            raise ConfigError(f"smooth = {self.smooth} must be an odd number of frames, 5 or more.")

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Self:
        """The options of these names; raises a ConfigError for a name that is none of them."""
        names = [one.name for one in fields(cls)]
        if unknown := next((name for name in facts if name not in names), None):
            raise ConfigError(f"{unknown} is no fact; known: {', '.join(names)}.{suggestion(unknown, names)}")
        return cls(**facts)

    @property
    def arguments(self) -> list[str]:
        """The options of commands that state these facts."""
        written = {
            one.name: one.metadata.get("text", _PLAIN).write(value)
            for one in fields(Options)
            if (value := getattr(self, one.name)) is not None
        }
        return [f"--{name}={text}" for name, text in written.items() if text]

    @property
    def changes_positions(self) -> bool:
        """Whether files in the native layout cannot be used as they are."""
        return self.resample is not None or self.smooth is not None

    @property
    def of_converted(self) -> Options:
        """The same for data that are resampled and smoothed already."""
        return replace(self, dt=self.resample or self.dt, resample=None, smooth=None, files=None)

    @property
    def settled(self) -> frozenset[str]:
        """Fields of the metadata that these facts settle; names of types may be of some types only."""
        names = {"static": "static_types"} | {name: name for name in ("bounds", "dt", "gravity", "boundary")}
        return frozenset(field for name, field in names.items() if getattr(self, name) is not None)

    def apply_to(self, metadata: Metadata) -> Metadata:
        """The metadata with the user's corrections; the family is applied where the type ids are read.

        Raises:
            ConfigError: if a value does not match the number of axes.
        """
        changes: dict[str, Any] = {name: getattr(self, name) for name in ("bounds", "gravity", "boundary")}
        for name, value in changes.items():
            if value is not None and len(value) != metadata.dim:
                raise ConfigError(f"{name} = {list(value)} needs one entry for each of the data's {metadata.dim} axes.")
        static, prescribed = metadata.static_types, metadata.prescribed_types - (self.static or frozenset())
        if self.types:
            walls = frozenset(i for i, name in self.types.items() if name in STATIC_NAMES)
            static, prescribed = (static - frozenset(self.types)) | walls, prescribed - frozenset(self.types)
        changes |= {
            "particle_types": metadata.particle_types | dict(self.types or {}),
            "static_types": static if self.static is None else self.static,
            "prescribed_types": prescribed if self.prescribed is None else self.prescribed,
            "dt": self.resample or self.dt,
            "fields": self.fields,
            "extra": metadata.extra | {AXES: self.axes} if self.axes else None,
        }
        if self.bounds is not None:
            metadata = replace(metadata, domain=None)
        return replace(metadata, **{name: value for name, value in changes.items() if value is not None})
