"""Facts that all trajectories of a dataset share, and their file `metadata.json`.

The file has DeepMind's keys, and optional ones for facts that DeepMind's do not state.

Required are `bounds`, `dt`, `dim` and `sequence_length` (as in DeepMind's files this may be one less than the frames
stored). Optional are `particle_types` ({"7": "goop"}), `static_types` ([3]), `prescribed_types` ([2], obstacles that
move as recorded), `domain`, `gravity` (length/s²), `particle_volume` (length ** dim), `densities` ({"water": 1000}, kg
/ length ** dim), `periodic_boundary_conditions`, `boundary` (["wall", "open"], where an axis is open) and `fields`
(["temperature"], see `nmpm.data.fields`). All other keys are kept unchanged.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from operator import eq, ge
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, get_args

import numpy as np

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import check_plain, read_bounded
from nmpm._support.messages import one_line
from nmpm._support.plain_data import fits, is_finite, to_tuples
from nmpm.data.families import FAMILIES, PADDING, STATIC_NAMES, find_family
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Boundary, Interval, Scene, check_field_names

METADATA_FILE = "metadata.json"

_SHARED = ("bounds", "domain", "dt", "boundary", "gravity", "particle_volume")
"""Facts that metadata and scenes have under the same names."""

FOUND = "found"
"""Key of `metadata.json`: how each fact was found in the trajectories, a sentence by the fact's name."""

Value = TypeVar("Value")
Sure = Literal["measured", "likely", "guessed"]


@dataclass(frozen=True)
class Fact(Generic[Value]):
    """A value that was found in the trajectories, with one sentence on how."""

    value: Value
    how: str
    sure: Sure

    def __str__(self) -> str:
        return f"{self.sure}: {self.how}"


@dataclass(frozen=True)
class Metadata:
    """Facts that all trajectories of a dataset share; lengths in domain length, times in seconds."""

    bounds: tuple[Interval, ...]  # where particles may be, (lower, upper) per axis
    dt: float  # time between stored frames (LagrangeBench's `dt` times its `write_every`)
    dim: int
    sequence_length: int  # frames per trajectory as the dataset declares them
    particle_types: dict[int, str]  # name of each type id
    static_types: frozenset[int] = frozenset()  # ids of the types that do not move
    prescribed_types: frozenset[int] = frozenset()  # ids of obstacles that move as recorded; taken out of static_types
    boundary: tuple[Boundary, ...] = ()  # per axis; walls when left out
    domain: tuple[Interval, ...] | None = None  # what a grid should cover, (lower, upper) per axis
    gravity: tuple[float, ...] | None = None  # acceleration in length/s² per axis; None where unknown
    particle_volume: float | None = None  # in length ** dim; None where unknown
    densities: dict[str, float] = field(default_factory=dict)  # of materials, in kg / length ** dim, where known
    fields: tuple[str, ...] = ()  # names of the fields that every trajectory has, which are inputs of models
    extra: dict[str, Any] = field(default_factory=dict)  # every other key of the file, unchanged

    def __post_init__(self) -> None:
        if not self.boundary:
            object.__setattr__(self, "boundary", ("wall",) * self.dim)
        object.__setattr__(self, "static_types", self.static_types - self.prescribed_types)

    @property
    def periodic(self) -> tuple[bool, ...]:
        """Whether each axis wraps."""
        return tuple(kind == "periodic" for kind in self.boundary)

    @property
    def obstacle_types(self) -> frozenset[int]:
        """Ids of the types that are not predicted: static, or moving as recorded."""
        return self.static_types | self.prescribed_types

    @property
    def moving_types(self) -> tuple[int, ...]:
        """Ids of the materials, which move and are predicted, in order of id."""
        names = self.particle_types
        return tuple(sorted(i for i in names if i not in self.obstacle_types and names[i] != PADDING))

    def is_moving(self, particle_type: np.ndarray) -> np.ndarray:
        """(N,) bool, of (N,) type ids."""
        return np.isin(particle_type, self.moving_types)

    def is_static(self, particle_type: np.ndarray) -> np.ndarray:
        """(N,) bool, of (N,) type ids."""
        return np.isin(particle_type, list(self.static_types))

    def is_obstacle(self, particle_type: np.ndarray) -> np.ndarray:
        """(N,) bool, of (N,) type ids: static, or moving as recorded."""
        return np.isin(particle_type, list(self.obstacle_types))

    def scene(self, types: Collection[int], **facts: Any) -> Scene:
        """The scene of trajectories in which these types occur, with further facts, or other ones."""
        shared = {name: getattr(self, name) for name in _SHARED} | {"domain": self.domain or self.bounds}
        materials = tuple(dict.fromkeys(self.particle_types[i] for i in self.moving_types if i in types))
        obstacles, moving = (bool(ids.intersection(types)) for ids in (self.obstacle_types, self.prescribed_types))
        return Scene(**shared | {"materials": materials, "obstacles": obstacles, "moving_obstacles": moving} | facts)

    def unknown_types(self, particle_type: np.ndarray) -> list[int]:
        """Ids in an array that have no name, ascending."""
        return sorted(set(np.unique(particle_type).tolist()) - set(self.particle_types))

    def check_types(self, particle_type: np.ndarray, where: str) -> None:
        """Raises a DataError that names unknown type ids in an array, and `where` they occur."""
        if unknown := self.unknown_types(particle_type):
            named = ", ".join(f"{i} {name}" for i, name in sorted(self.particle_types.items()))
            raise DataError(
                f"{where}: unknown particle type {', '.join(map(str, unknown))} (known: {named}). Name it: --types"
                f" {unknown[0]}=sand (to fit, in a copy: nmpm convert DATA NEW --types {unknown[0]}=sand), or in"
                f' {METADATA_FILE}, "particle_types": {{"{unknown[0]}": "sand"}}; or state another family:'
                f" --family {' or '.join(sorted(FAMILIES))}."
            )


def scene_metadata(scene: Scene, types: dict[int, str], static_type: int | None) -> Metadata:
    """The metadata of trajectories of a scene whose type ids have these names; their length is still to be set."""
    obstacle = frozenset() if static_type is None else frozenset({static_type})
    return Metadata(
        dim=scene.dim,
        sequence_length=1,
        particle_types=types,
        static_types=obstacle,
        prescribed_types=obstacle if scene.moving_obstacles else frozenset(),
        densities=dict(zip(scene.materials, scene.densities, strict=True)) if scene.densities else {},
        **{name: getattr(scene, name) for name in (*_SHARED, "fields")},
    )


_BYTES = 2**24
_LENGTH_KEYS = ("sequence_length", "sequence_length_train", "sequence_length_test")


def read_metadata(folder: Path, family: str | None = None, types: Mapping[int, str] | None = None) -> Metadata:
    """Reads and checks a dataset's `metadata.json`.

    A family, or else names of types, give the type ids their meaning where the file does not; a file that contradicts
    the family wins, with a warning.

    Raises:
        DataError: if the file is missing or not JSON, or a key is missing or has a wrong value.
        ConfigError: if there is no such family.
    """
    path = Path(folder) / METADATA_FILE
    return parse_metadata(load_json(path), path, family, types)


def parse_metadata(
    plain: Mapping[str, Any],
    where: Path,
    family: str | None = None,
    types: Mapping[int, str] | None = None,
    problems: list[str] | None = None,
    substitutes: Mapping[str, Any] | None = None,
) -> Metadata:
    """As `read_metadata`, of the JSON object of a file.

    Where problems are collected instead of raised, `substitutes` are the values of keys that are missing or wrong.
    """
    check_plain(plain, where)
    keys = JsonKeys(where, plain, problems, substitutes)
    dim = keys.dim = keys.take("dim")
    names, static, prescribed = _types(keys, family, types)
    length_key = next((key for key in _LENGTH_KEYS if key in keys.left), _LENGTH_KEYS[0])
    length = keys.peek(length_key)
    keys.left.pop("sequence_length", None)
    periodic = keys.take("periodic_boundary_conditions", (False,) * dim)[:dim]
    return Metadata(
        bounds=keys.take("bounds"),
        dt=keys.take("dt") * keys.peek("write_every", 1.0),
        dim=dim,
        sequence_length=length,
        particle_types=names,
        static_types=static,
        prescribed_types=keys.take("prescribed_types", prescribed),
        boundary=keys.take("boundary", tuple("periodic" if wraps else "wall" for wraps in periodic)),
        domain=keys.take("domain", None),
        gravity=keys.take("gravity", None),
        particle_volume=keys.take("particle_volume", None),
        densities=keys.take("densities", {}),
        fields=keys.take("fields", ()),
        extra=keys.left,
    )


def _types(
    keys: JsonKeys, family: str | None, stated: Mapping[int, str] | None
) -> tuple[dict[int, str], frozenset[int], frozenset[int]]:
    """Names of type ids and static ids, from the file or else the family, and the family's prescribed ids."""
    fallback = find_family(family) if family is not None else None
    default = fallback.types if fallback else stated
    if default is None and keys.left.get("particle_types") is None and keys.problems is None:
        raise DataError(
            f"{keys.where}: the key 'particle_types' is missing, so the type ids have no meaning. Add it, e.g."
            f' "particle_types": {{"7": "goop"}}, or state the names, --types 7=goop, or the family that has them,'
            f" --family {' or '.join(sorted(FAMILIES))} (fit: --data.family)."
        )
    types: dict[int, str] = keys.take("particle_types", REQUIRED if default is None else dict(default))
    names = fallback.types if fallback else types
    different = [f"{i} = {name}, not {names[i]}" for i, name in types.items() if names.get(i, name) != name]
    if different:
        warnings.warn(
            f"{keys.where} names its particle types itself ({'; '.join(different)}): the family {family} is not used.",
            stacklevel=4,
        )
    walls = frozenset(i for i, name in types.items() if name in STATIC_NAMES)
    static = keys.take("static_types", fallback.static if fallback else walls)
    prescribed = fallback.prescribed - static if fallback else frozenset()
    return types, static, frozenset(i for i in prescribed if types.get(i) == names[i])


def write_metadata(folder: Path, metadata: Metadata) -> None:
    """Writes `metadata.json` atomically, or raises a DataError; `read_metadata` then returns equal metadata."""
    solver_steps = metadata.extra.get("write_every", 1)
    plain: dict[str, Any] = {
        "bounds": metadata.bounds,
        "dt": metadata.dt / solver_steps,
        "dim": metadata.dim,
        "sequence_length": metadata.sequence_length,
        "particle_types": {str(i): name for i, name in sorted(metadata.particle_types.items())},
        "static_types": sorted(metadata.static_types),
        "prescribed_types": sorted(metadata.prescribed_types) or None,
        "periodic_boundary_conditions": metadata.periodic,
        "boundary": metadata.boundary if "open" in metadata.boundary else None,
        "domain": metadata.domain,
        "gravity": metadata.gravity,
        "particle_volume": metadata.particle_volume,
        "densities": metadata.densities or None,
        "fields": metadata.fields or None,
    }
    plain = {key: value for key, value in plain.items() if value is not None} | metadata.extra
    path = Path(folder) / METADATA_FILE
    try:
        with atomic_write(path) as part:
            part.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise DataError(
            f"{path}: cannot be written ({error.strerror}). Free space, or choose another folder."
        ) from error


def load_json(path: Path) -> dict[str, Any]:
    """The JSON object in a dataset's `metadata.json`, not validated; raises a DataError if there is none."""
    if not path.parent.is_dir():
        raise DataError(f"{path.parent}: no such folder. Give the folder that contains {METADATA_FILE}.")
    if not path.exists():
        raise DataError(f"{path}: no such file. A dataset needs this file, with bounds, dt, dim and sequence_length.")
    return parse_json(read_bounded(path, _BYTES), path)


def parse_json(text: str | bytes, where: Path | str) -> dict[str, Any]:
    """The JSON object of a text; raises a DataError if it is not JSON, not an object, or not plain."""
    try:
        plain = json.loads(text)
    except (ValueError, RecursionError, MemoryError) as error:
        raise DataError(f"{where}: not valid JSON ({one_line(error)}).") from error
    if not isinstance(plain, dict):
        raise DataError(f"{where}: expected a JSON object, found {type(plain).__name__}.")
    check_plain(plain, where)
    return plain


@dataclass(frozen=True)
class _Key:
    """The form of a key's value."""

    wanted: str  # in words, for {dim} axes
    kind: Any  # with tuples for lists
    check: Callable[[Any], bool] = lambda _: True
    read: Callable[[Any], Any] = lambda value: value
    length: Callable[[int, int], bool] | None = None  # how a list's is compared with the number of axes

    def fits(self, value: Any, dim: int) -> bool:
        """Whether a value of a scene of so many axes has the form."""
        right = fits(value, self.kind) and (self.length is None or self.length(len(value), dim))
        return right and self.check(value)


def _floats(value: Any) -> Any:
    return tuple(map(_floats, value)) if isinstance(value, tuple) else float(value)


def _field_names(names: tuple[str, ...]) -> tuple[str, ...]:
    check_field_names(names)
    return names


_COUNT = _Key("a positive integer", int, lambda value: value > 0)
_POSITIVE = _Key("a positive number", float, lambda value: value > 0, float)
_IDS = _Key("a list of type ids", tuple[int, ...], read=frozenset)
_INTERVALS = _Key(
    "a list of {dim} pairs [lower, upper] with lower < upper, one per axis",
    tuple[Interval, ...],
    lambda pairs: all(low < high for low, high in pairs),
    _floats,
    eq,
)
_KEYS: Mapping[str, _Key] = {
    "dim": _Key("1, 2 or 3", Literal[1, 2, 3]),
    "sequence_length": _COUNT,
    "sequence_length_train": _COUNT,
    "sequence_length_test": _COUNT,
    "dt": _POSITIVE,
    "write_every": _POSITIVE,
    "particle_volume": _POSITIVE,
    "bounds": _INTERVALS,
    "domain": _INTERVALS,
    "gravity": _Key("a list of {dim} finite numbers, one per axis", tuple[float, ...], read=_floats, length=eq),
    "boundary": _Key(f"{', '.join(get_args(Boundary))} per axis", tuple[Boundary, ...], length=eq),
    # LagrangeBench gives three to two-dimensional scenes as well.
    "periodic_boundary_conditions": _Key(
        "a list of at least {dim} booleans, one per axis", tuple[bool, ...], length=ge
    ),
    "particle_types": _Key(
        'an object that maps integers to names, e.g. {"7": "goop"}',
        Mapping[str, Any],
        lambda names: bool(names) and all(re.fullmatch(r"-?\d{1,18}", i) and type(n) is str for i, n in names.items()),
        lambda names: {int(i): name for i, name in names.items()},
    ),
    "static_types": _IDS,
    "prescribed_types": _IDS,
    "densities": _Key(
        'positive numbers by material, e.g. {"water": 1000}',
        Mapping[str, Any],
        lambda densities: all(is_finite(each) and each > 0 for each in densities.values()),
        lambda densities: {str(name): float(density) for name, density in densities.items()},
    ),
    "fields": _Key('a list of names of fields, e.g. ["temperature"]', tuple[str, ...], read=_field_names),
}
REQUIRED: Any = object()
"""In place of a default: the key must be there."""


class JsonKeys:
    """The keys of a JSON object in a file that are not taken yet.

    Where problems are collected instead of raised, keys that are missing or wrong have the value of `substitutes`, or
    else their default.
    """

    def __init__(
        self,
        where: Path | str,
        plain: Mapping[str, Any],
        problems: list[str] | None = None,
        substitutes: Mapping[str, Any] | None = None,
    ) -> None:
        self.where, self.left, self.problems, self.substitutes = where, dict(plain), problems, substitutes or {}
        self.dim = 0

    def peek(self, key: str, default: Any = REQUIRED) -> Any:
        """The value of a key."""
        value, form, reason = to_tuples(self.left.get(key)), _KEYS[key], ""
        if value is None and default is not REQUIRED:
            return default
        problem = f"{self.where}: the key {key!r} is missing."
        if value is not None:
            try:
                if form.fits(value, self.dim):
                    return form.read(value)
            except ConfigError as error:
                reason = f" ({error})"
            shown = one_line(json.dumps(value, default=repr), 80)
            problem = f"{self.where}: {key} = {shown} should be {form.wanted.replace('{dim}', str(self.dim))}{reason}."
        if self.problems is None:
            raise DataError(problem)
        self.problems.append(problem)
        return self.substitutes.get(key, default)

    def take(self, key: str, default: Any = REQUIRED) -> Any:
        """As `peek`, and removes the key from those that are left."""
        value = self.peek(key, default)
        self.left.pop(key, None)
        return value
