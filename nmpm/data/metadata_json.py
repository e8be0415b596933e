"""Reads and writes `metadata.json`: DeepMind's keys, and optional ones for facts that DeepMind's do not state.

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
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import check_plain, read_bounded
from nmpm._support.messages import one_line
from nmpm._support.numbers import is_finite
from nmpm.data.metadata import FAMILIES, METADATA_FILE, STATIC_NAMES, Metadata, find_family
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Boundary, Interval, check_field_names

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
    dim = keys.take("dim", parse_dim)
    names, static, prescribed = _types(keys, family, types)
    length_key = next((key for key in _LENGTH_KEYS if key in keys.left), _LENGTH_KEYS[0])
    length = keys.peek(length_key, parse_count)
    keys.left.pop("sequence_length", None)
    periodic = keys.take("periodic_boundary_conditions", lambda value: parse_flags(value, dim), (False,) * dim)
    kinds: tuple[Boundary, ...] = tuple("periodic" if wraps else "wall" for wraps in periodic)
    return Metadata(
        bounds=keys.take("bounds", lambda value: parse_intervals(value, dim)),
        dt=keys.take("dt", parse_positive) * keys.peek("write_every", parse_positive, 1.0),
        dim=dim,
        sequence_length=length,
        particle_types=names,
        static_types=static,
        prescribed_types=keys.take("prescribed_types", parse_ids, prescribed),
        boundary=keys.take("boundary", lambda value: parse_boundary(value, dim), kinds),
        domain=keys.take("domain", lambda value: parse_intervals(value, dim), None),
        gravity=keys.take("gravity", lambda value: parse_vector(value, dim), None),
        particle_volume=keys.take("particle_volume", parse_positive, None),
        densities=keys.take("densities", parse_densities, {}),
        fields=keys.take("fields", parse_field_names, ()),
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
    types: dict[int, str] = keys.take("particle_types", parse_names, REQUIRED if default is None else dict(default))
    names = fallback.types if fallback else types
    different = [f"{i} = {name}, not {names[i]}" for i, name in types.items() if names.get(i, name) != name]
    if different:
        warnings.warn(
            f"{keys.where} names its particle types itself ({'; '.join(different)}): the family {family} is not used.",
            stacklevel=4,
        )
    walls = frozenset(i for i, name in types.items() if name in STATIC_NAMES)
    static = keys.take("static_types", parse_ids, fallback.static if fallback else walls)
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

    def peek(self, key: str, parse: Callable[[Any], Any], default: Any = REQUIRED) -> Any:
        """The parsed value of a key; `parse` raises a TypeError or ValueError that states what is wanted."""
        value = self.left.get(key)
        if value is None and default is not REQUIRED:
            return default
        try:
            if value is not None:
                return parse(value)
            problem = f"{self.where}: the key {key!r} is missing."
        except (TypeError, ValueError) as error:
            problem = f"{self.where}: {key} = {one_line(json.dumps(value, default=repr), 80)} should be {error}."
        if self.problems is None:
            raise DataError(problem)
        self.problems.append(problem)
        return self.substitutes.get(key, default)

    def take(self, key: str, parse: Callable[[Any], Any], default: Any = REQUIRED) -> Any:
        """As `peek`, and removes the key from those that are left."""
        value = self.peek(key, parse, default)
        self.left.pop(key, None)
        return value


def parse_dim(value: Any) -> int:
    """1, 2 or 3."""
    _check(value in (1, 2, 3) and not isinstance(value, bool | float), "1, 2 or 3")
    return int(value)


def parse_count(value: Any) -> int:
    """A positive integer."""
    _check(isinstance(value, int) and not isinstance(value, bool) and value > 0, "a positive integer")
    return int(value)


def parse_positive(value: Any) -> float:
    """A positive, finite number."""
    _check(is_finite(value) and value > 0, "a positive number")
    return float(value)


def parse_densities(value: Any) -> dict[str, float]:
    """Positive numbers by name."""
    _check(isinstance(value, Mapping), 'positive numbers by material, e.g. {"water": 1000}')
    return {str(name): parse_positive(density) for name, density in value.items()}


def parse_field_names(value: Any) -> tuple[str, ...]:
    """Names of fields from a list."""
    _check(_is_list(value, str), 'a list of names of fields, e.g. ["temperature"]')
    try:
        check_field_names(value)
    except ConfigError as error:
        raise ValueError(f"a list of names of fields ({error})") from error
    return tuple(value)


def parse_ids(value: Any) -> frozenset[int]:
    """A set of type ids from a list."""
    _check(_is_list(value, int) and not any(isinstance(i, bool) for i in value), "a list of type ids")
    return frozenset(value)


def parse_names(value: Any) -> dict[int, str]:
    """Names by type id."""
    named = isinstance(value, Mapping) and value and all(isinstance(name, str) for name in value.values())
    _check(named, 'an object that maps ids to names, e.g. {"7": "goop"}')
    _check(all(re.fullmatch(r"-?\d{1,18}", i) for i in value), 'an object whose keys are integers, e.g. {"7": "goop"}')
    return {int(i): name for i, name in value.items()}


def parse_vector(value: Any, dim: int) -> tuple[float, ...]:
    """`dim` finite numbers."""
    finite = isinstance(value, list) and len(value) == dim and all(map(is_finite, value))
    _check(finite, f"a list of {dim} finite numbers, one per axis")
    return tuple(map(float, value))


def parse_intervals(value: Any, dim: int) -> tuple[Interval, ...]:
    """(lower, upper) for each of `dim` axes."""
    wanted = f"a list of {dim} pairs [lower, upper] with lower < upper, one per axis"
    _check(_is_list(value, list) and len(value) == dim and all(len(pair) == 2 for pair in value), wanted)
    _check(all(all(map(is_finite, pair)) and pair[0] < pair[1] for pair in value), wanted)
    return tuple((float(low), float(high)) for low, high in value)


def parse_flags(value: Any, dim: int) -> tuple[bool, ...]:
    """A truth value for each of `dim` axes; LagrangeBench gives three to two-dimensional scenes as well."""
    _check(_is_list(value, bool) and len(value) >= dim, f"a list of at least {dim} booleans, one per axis")
    return tuple(value[:dim])


def parse_boundary(value: Any, dim: int) -> tuple[Boundary, ...]:
    """The kind of boundary of each of `dim` axes."""
    known = get_args(Boundary)
    _check(_is_list(value, str) and len(value) == dim and set(value) <= set(known), f"{', '.join(known)} per axis")
    return tuple(value)


def _is_list(value: Any, kind: type) -> bool:
    return isinstance(value, list) and all(isinstance(item, kind) for item in value)


def _check(holds: Any, wanted: str) -> None:
    if not holds:
        raise ValueError(wanted)
