"""The fixed facts of a dataset's scenes: bounds, domain, materials, gravity, and which of them vary.

A `Scene` alone decides the grid channels of a model: a scene of one material in a box has a velocity, a volume fraction
and a wall channel; gravity becomes channels only where it varies, obstacles only where there are any, further fields,
such as a temperature, only where they are declared and vary.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Self, TypeVar, get_args

from nmpm._support.plain_data import from_plain, to_plain
from nmpm.errors import ConfigError

Boundary = Literal["wall", "periodic", "open"]
Interval = tuple[float, float]
T = TypeVar("T")

_RESERVED = frozenset({"position", "particle_type", "velocity", "volume", "solid", "gravity"})


_SAME = 1e-6
"""Share of a domain's extent by which the ends of a period may differ, as by rounding."""


@dataclass(frozen=True)
class Turn:
    """A permutation and mirroring of axes, such as ("x", "z", "-y"): y of the result is z, and z is -y.

    Args:
        axes: For each axis of the result the one that it is taken from, with a minus sign where it is mirrored.

    Raises:
        ConfigError: if these are not all axes of a scene, each once.
    """

    axes: tuple[str, ...]

    def __post_init__(self) -> None:
        names = sorted(axis.removeprefix("-") for axis in self.axes)
        if not 1 <= len(names) <= 3 or names != list("xyz"[: len(names)]):
            raise ConfigError(f"A turn names each axis once, such as ('x', 'z', '-y'); got {self.axes}.")

    @property
    def sources(self) -> tuple[int, ...]:
        """For each axis of the result the index of the one that it is taken from."""
        return tuple("xyz".index(axis[-1]) for axis in self.axes)

    @property
    def mirrored(self) -> tuple[bool, ...]:
        """Whether each axis of the result is mirrored."""
        return tuple(axis.startswith("-") for axis in self.axes)

    @property
    def is_identity(self) -> bool:
        """Whether each axis stays as it is."""
        return "".join(self.axes) == "xyz"[: len(self.axes)]

    @property
    def inverse(self) -> Turn:
        """The turn back."""
        back = sorted(zip(self.sources, self.mirrored, "xyz", strict=False))
        return Turn(tuple(f"-{axis}" if mirror else axis for _, mirror, axis in back))

    def after(self, first: Turn) -> Turn:
        """Both turns, this one last."""
        axes = (f"-{first.axes[at]}" if mirror else first.axes[at] for at, mirror in self._pairs)
        return Turn(tuple(axis.replace("--", "") for axis in axes))

    def vector(self, values: Sequence[float]) -> tuple[float, ...]:
        """A vector (D,) in the result's axes."""
        return tuple((-values[at] or 0.0) if mirror else values[at] for at, mirror in self._pairs)

    def intervals(self, sides: Sequence[Interval]) -> tuple[Interval, ...]:
        """Lower and upper ends (D,) along the result's axes."""
        pairs = ((sides[at], mirror) for at, mirror in self._pairs)
        return tuple((-high or 0.0, -low or 0.0) if mirror else (low, high) for (low, high), mirror in pairs)

    def permuted(self, values: Sequence[T]) -> tuple[T, ...]:
        """Values of the axes, in the result's order."""
        return tuple(values[at] for at in self.sources)

    def channels(self, names: Sequence[str]) -> tuple[tuple[int, bool], ...]:
        """For each channel of the result the index of the one that it is taken from, and whether its sign changes.

        Channels whose names end with _x, _y (and _z) are the components of a vector; the others stay.
        """
        taken = []
        for at, name in enumerate(names):
            stem, axis = name[:-1], name[-1:]
            parts = [f"{stem}{each}" for each in "xyz"[: len(self.axes)]]
            if stem.endswith("_") and name in parts and set(parts) <= set(names):
                source, mirror = self._pairs["xyz".index(axis)]
                taken.append((names.index(parts[source]), mirror))
            else:
                taken.append((at, False))
        return tuple(taken)

    @property
    def _pairs(self) -> tuple[tuple[int, bool], ...]:
        return tuple(zip(self.sources, self.mirrored, strict=True))


@dataclass(frozen=True)
class Scene:
    """The fixed facts of a family of scenes, in the dataset's physical units.

    Args:
        bounds: Where particles may be, (lower, upper) per axis, in domain length.
        domain: What the grid covers, (lower, upper) per axis; contains the bounds and, at walls, a wall layer. On
            a periodic axis both are the same, the period.
        dt: Time between frames, in seconds.
        materials: Names of the moving materials, in the order of their channels.
        particle_volume: Volume of one particle, in length ** dim.
        boundary: "wall", "periodic" or "open" per axis; walls everywhere when left out. Particles that leave the bounds
            of an open axis are gone.
        gravity: External acceleration in length per second squared; None where it is not known.
        gravity_varies: Whether each trajectory has its own gravity, so that the model must be told.
        obstacles: Whether there are particles that are not predicted: at rest, or moving as recorded.
        moving_obstacles: Whether some of them move.
        densities: Mass density of each material, in kg per length ** dim; all the same when left out.
        evolving: Names of per-particle fields that change in time and are predicted, such as a temperature.
        properties: Names of per-particle fields that are constant in time, such as a stiffness.
        parameters: Names of numbers that each trajectory has one of, such as a friction angle.
        aliases: Pairs of a name that data give a material and the name that it has here, such as ("grains", "sand").

    Raises:
        ConfigError: if the facts contradict each other.
    """

    bounds: tuple[Interval, ...]
    domain: tuple[Interval, ...]
    dt: float
    materials: tuple[str, ...]
    particle_volume: float
    boundary: tuple[Boundary, ...] = ()
    gravity: tuple[float, ...] | None = None
    gravity_varies: bool = False
    obstacles: bool = False
    densities: tuple[float, ...] = ()
    evolving: tuple[str, ...] = ()
    properties: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    moving_obstacles: bool = False
    aliases: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        if not self.boundary:
            object.__setattr__(self, "boundary", ("wall",) * self.dim)
        self._check()

    def _check(self) -> None:
        if self.dim not in (1, 2, 3):
            raise ConfigError(f"A scene has 1, 2 or 3 axes; bounds {self.bounds} have {self.dim}.")
        for name in ("domain", "boundary") + (("gravity",) if self.gravity is not None else ()):
            if len(getattr(self, name)) != self.dim:
                raise ConfigError(f"Scene.{name} = {getattr(self, name)} needs one entry for each of {self.dim} axes.")
        for axis, (inner, outer, kind) in enumerate(zip(self.bounds, self.domain, self.boundary, strict=True)):
            (low, high), (outer_low, outer_high) = inner, outer
            if not (outer_low <= low < high <= outer_high and math.isfinite(outer_high - outer_low)):
                raise ConfigError(f"On axis {axis} the domain {outer} must contain the bounds {inner}.")
            if kind not in get_args(Boundary):
                raise ConfigError(f"Boundary {kind!r} is not one of {', '.join(get_args(Boundary))}.")
            if kind == "periodic" and max(low - outer_low, outer_high - high) > _SAME * (outer_high - outer_low):
                raise ConfigError(
                    f"Axis {axis} is periodic: the bounds {inner} and the domain {outer} must be the same, one period"
                    " apart."
                )
        if self.moving_obstacles and not self.obstacles:
            raise ConfigError("A scene with moving_obstacles has obstacles.")
        if not (self.dt > 0 and self.particle_volume > 0):
            raise ConfigError(f"dt = {self.dt} and particle_volume = {self.particle_volume} must be positive.")
        if not self.materials or len(set(self.materials)) != len(self.materials):
            raise ConfigError(f"A scene needs at least one material, each named once; got {self.materials}.")
        if self.densities and len(self.densities) != len(self.materials):
            raise ConfigError(f"Scene.densities = {self.densities} needs one entry for each of {self.materials}.")
        if not all(0 < density < math.inf for density in self.densities):
            raise ConfigError(f"Scene.densities = {self.densities} must be positive and finite.")
        if unknown := [to for _, to in self.aliases if to not in self.materials]:
            raise ConfigError(f"Scene.aliases: {unknown[0]!r} is none of the materials {self.materials}.")
        check_field_names(self.fields)

    @property
    def dim(self) -> int:
        """Number of space dimensions."""
        return len(self.bounds)

    @property
    def periodic(self) -> tuple[bool, ...]:
        """Whether each axis wraps."""
        return tuple(kind == "periodic" for kind in self.boundary)

    @property
    def confined(self) -> tuple[bool, ...]:
        """Whether each axis ends at walls."""
        return tuple(kind == "wall" for kind in self.boundary)

    @property
    def is_closed(self) -> bool:
        """Whether nothing leaves or brings energy in: no axis is open and no obstacle moves."""
        return "open" not in self.boundary and not self.moving_obstacles

    @property
    def walled(self) -> bool:
        """Whether the grid has a solid channel: for a wall layer or obstacles."""
        sides = zip(self.bounds, self.domain, self.boundary, strict=True)
        return self.obstacles or any(inner != outer and kind != "open" for inner, outer, kind in sides)

    @property
    def gravity_known(self) -> bool:
        """Whether states carry the scene's gravity; otherwise theirs is zero because it is unknown."""
        return self.gravity is not None or self.gravity_varies

    @property
    def volume(self) -> float:
        """Volume within the bounds, in length ** dim."""
        return math.prod(high - low for low, high in self.bounds)

    @property
    def particle_spacing(self) -> float:
        """Distance between particles on a square lattice of their own density, in length."""
        return float(self.particle_volume ** (1 / self.dim))

    @property
    def particle_fields(self) -> tuple[str, ...]:
        """Names of the fields of which each particle has a value, those that are predicted first."""
        return self.evolving + self.properties

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of all fields that the model is told, those of particles first."""
        return self.particle_fields + self.parameters

    @property
    def input_channels(self) -> tuple[str, ...]:
        """Names of the grid channels the processor sees, in order."""
        axes = "xyz"[: self.dim]
        names = [f"{m}.velocity_{a}" for m in self.materials for a in axes]
        names += [f"{m}.volume" for m in self.materials]
        names += ["solid"] if self.walled else []
        names += [f"solid.velocity_{a}" for a in axes] if self.moving_obstacles else []
        names += [f"gravity_{a}" for a in axes] if self.gravity_varies else []
        names += [f"{m}.{f}" for m in self.materials for f in self.particle_fields]
        return (*names, *self.parameters)

    @property
    def output_channels(self) -> tuple[str, ...]:
        """Names of the channels that the processor predicts for each frame: velocities, then rates of fields."""
        rates = (f"{m}.{f}" for m in self.materials for f in self.evolving)
        return (*self.input_channels[: self.dim * len(self.materials)], *rates)

    def differences(self, other: Scene) -> tuple[str, ...]:
        """Names of the facts that differ between a model's scene and its data's, and may not.

        Names of materials, their aliases, densities and fields are not compared.
        """
        facts = ("bounds", "domain", "dt", "boundary", "gravity", "gravity_varies", "obstacles", "moving_obstacles")
        different = [name for name in facts if getattr(self, name) != getattr(other, name)]
        if len(self.materials) != len(other.materials):
            different.append("materials")
        if not is_same_volume(self.particle_volume, other.particle_volume):
            different.append("particle_volume")
        return tuple(different)

    def with_fields_of(self, other: Scene) -> Self:
        """The same scene with another's fields: what a model of that other scene is told about this one."""
        return dataclasses.replace(
            self, evolving=other.evolving, properties=other.properties, parameters=other.parameters
        )

    def with_domain_moved(self, shift: Sequence[float]) -> Self:
        """The same scene covered by a domain that is moved by `shift` (D,), in domain length; periods move with it.

        Raises:
            ConfigError: if the domain would no longer contain the bounds.
        """
        domain = tuple((low + d, high + d) for (low, high), d in zip(self.domain, shift, strict=True))
        sides = zip(self.bounds, shift, self.periodic, strict=True)
        bounds = tuple((low + d, high + d) if wraps else (low, high) for (low, high), d, wraps in sides)
        return dataclasses.replace(self, bounds=bounds, domain=domain)

    def turned(self, turn: Turn) -> Self:
        """The same scene in the axes that a turn makes of its own."""
        return dataclasses.replace(
            self,
            bounds=turn.intervals(self.bounds),
            domain=turn.intervals(self.domain),
            boundary=turn.permuted(self.boundary),
            gravity=None if self.gravity is None else turn.vector(self.gravity),
        )

    def to_dict(self) -> dict[str, Any]:
        """The scene as plain lists, strings and numbers; without what is optional and absent."""
        plain = dataclasses.asdict(self)
        for name in ("densities", "evolving", "properties", "parameters", "moving_obstacles", "aliases"):
            if not plain[name]:
                del plain[name]
        return {key: to_plain(value) for key, value in plain.items()}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """The scene described by `to_dict`.

        Raises:
            ConfigError: if a key is unknown, missing, or of the wrong kind.
        """
        return from_plain(cls, plain, "Scene")


@dataclass(frozen=True)
class Reading:
    """How a dataset is read for a model: as a scene of the model's materials, at the model's frames.

    Args:
        scene: The dataset's in its own units, but with the model's materials, and the `dt` of the model's frames.
        materials: The model's material by the dataset's name, of those that differ.
        every: Frames of the dataset per frame of the model; those between are skipped.
        between: Frames of the model per frame of the dataset; those that the dataset lacks count in no error.

    Raises:
        ConfigError: if a stride is not positive, or both are above 1.
    """

    scene: Scene
    materials: Mapping[str, str] = field(default_factory=dict)
    every: int = 1
    between: int = 1

    def __post_init__(self) -> None:
        if min(self.every, self.between) < 1 or max(self.every, self.between) > 1 < min(self.every, self.between):
            raise ConfigError(f"every = {self.every}, between = {self.between}: one is 1, the other 1 or more.")

    def data_frames(self, frames: int) -> int:
        """Frames of the dataset that a window of at least so many frames of the model needs, 3 or more."""
        return self.every * (frames - 1) + 1 if self.between == 1 else 2 + math.ceil((frames - 2) / self.between)

    def model_frames(self, frames: int) -> int:
        """Frames of the model that a window of so many frames of the dataset has; the first two are its start."""
        return (frames - 1) // self.every + 1 if self.between == 1 else 2 + self.between * (frames - 2)


@dataclass(frozen=True)
class Motion:
    """How a dataset's particles move, as measured in some of its trajectories; None where that is unknown.

    Args:
        rms: Root mean square of their speeds, in length per frame of the dataset.
        largest: Speed that all but the fastest 0.1% stay below, likewise.
        gravity: In length per second squared; measured where the scene states none, and where it varies each
            component's root mean square.
        frames: Of the shortest trajectory.
    """

    rms: float | None = None
    largest: float | None = None
    gravity: tuple[float, ...] | None = None
    frames: int | None = None

    def turned(self, turn: Turn) -> Self:
        """The same motion in the axes that a turn makes of its own."""
        return self if self.gravity is None else dataclasses.replace(self, gravity=turn.vector(self.gravity))


def is_same_volume(one: float, other: float) -> bool:
    """Whether volumes of particles, which may be estimates, agree to 5%."""
    return math.isclose(one, other, rel_tol=0.05)


def check_field_names(names: Iterable[str]) -> None:
    """Raise ConfigError unless names of fields can name channels.

    Raises:
        ConfigError: if one is no identifier, is taken by a channel that every scene has, or occurs twice.
    """
    known: set[str] = set()
    for name in names:
        taken = str(name).startswith(("gravity_", "velocity_")) or name in _RESERVED
        if not isinstance(name, str) or not name.isidentifier() or taken:
            raise ConfigError(
                f"A field cannot be called {str(name)[:40]!r}: give letters, digits and underscores, and none of"
                f" {', '.join(sorted(_RESERVED))}."
            )
        if name in known:
            raise ConfigError(f"The field {name!r} is given twice.")
        known.add(name)
