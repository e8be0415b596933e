"""The `metadata.json` of a dataset: DeepMind's keys, and optional ones for facts that DeepMind's do not state.

Required are `bounds`, `dt`, `dim` and `sequence_length` (as in DeepMind's files this may be one less than the frames
stored). Optional are `particle_types` ({"7": "goop"}), `static_types` ([3]), `domain`, `gravity` (length/s²),
`particle_volume` (length ** dim), `densities` ({"water": 1000}, kg / length ** dim), `periodic_boundary_conditions` and
`fields` (["temperature"], see `nmpm.data.fields`). All other keys are kept unchanged.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import check_plain, read_bounded
from nmpm._support.messages import one_line
from nmpm.data.families import FAMILIES, PADDING, STATIC_NAMES, find_family
from nmpm.data.json_keys import (
    REQUIRED,
    JsonKeys,
    parse_count,
    parse_densities,
    parse_dim,
    parse_field_names,
    parse_flags,
    parse_ids,
    parse_intervals,
    parse_names,
    parse_positive,
    parse_vector,
)
from nmpm.errors import DataError
from nmpm.scene import Interval

METADATA_FILE = "metadata.json"
_BYTES = 2**24
_LENGTH_KEYS = ("sequence_length", "sequence_length_train", "sequence_length_test")


@dataclass(frozen=True)
class Metadata:
    """Facts that all trajectories of a dataset share.

    Args:
        bounds: Where particles may be, (lower, upper) per axis, in domain length.
        dt: Time between stored frames, in seconds (LagrangeBench's `dt` times its `write_every`).
        dim: Number of space dimensions.
        sequence_length: Frames per trajectory as the dataset declares them.
        particle_types: Name of each particle type id.
        static_types: Ids of the types that do not move.
        periodic: Whether each axis is periodic; none when left out.
        domain: What a grid should cover, (lower, upper) per axis, or None.
        gravity: Acceleration in length/s² per axis, or None where unknown.
        particle_volume: Volume of a particle in length ** dim, or None where unknown.
        densities: Mass density of materials in kg / length ** dim, by name; empty where unknown.
        fields: Names of the fields that every trajectory has, which are inputs of models.
        extra: Every other key of the file, unchanged.
    """

    bounds: tuple[Interval, ...]
    dt: float
    dim: int
    sequence_length: int
    particle_types: dict[int, str]
    static_types: frozenset[int] = frozenset()
    periodic: tuple[bool, ...] = ()
    domain: tuple[Interval, ...] | None = None
    gravity: tuple[float, ...] | None = None
    particle_volume: float | None = None
    densities: dict[str, float] = field(default_factory=dict)
    fields: tuple[str, ...] = ()
    extra: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.periodic:
            object.__setattr__(self, "periodic", (False,) * self.dim)

    @property
    def moving_types(self) -> tuple[int, ...]:
        """Ids of the types that move, in order of id."""
        names = self.particle_types
        return tuple(sorted(i for i in names if i not in self.static_types and names[i] != PADDING))

    def is_moving(self, particle_type: np.ndarray) -> np.ndarray:
        """(N,) bool, of (N,) type ids."""
        return np.isin(particle_type, self.moving_types)

    def is_static(self, particle_type: np.ndarray) -> np.ndarray:
        """(N,) bool, of (N,) type ids."""
        return np.isin(particle_type, list(self.static_types))

    def unknown_types(self, particle_type: np.ndarray) -> list[int]:
        """Ids in an array that have no name, ascending."""
        return sorted(set(np.unique(particle_type).tolist()) - set(self.particle_types))

    def check_types(self, particle_type: np.ndarray, where: str) -> None:
        """Raises an error if an array has an unknown type id.

        Raises:
            DataError: names the unknown ids, and `where` they occur.
        """
        if unknown := self.unknown_types(particle_type):
            named = ", ".join(f"{i} {name}" for i, name in sorted(self.particle_types.items()))
            raise DataError(
                f"{where}: unknown particle type {', '.join(map(str, unknown))} (known: {named}). Name it in"
                f' {METADATA_FILE}, e.g. "particle_types": {{"{unknown[0]}": "sand"}}, or at conversion'
                f" (--types {unknown[0]}=sand), or choose another family"
                f" ({', '.join(sorted(FAMILIES))})."
            )


def read_metadata(folder: Path, family: str | None = None) -> Metadata:
    """Reads and checks a dataset's `metadata.json`.

    Args:
        folder: The dataset's folder.
        family: Meaning of the type ids ("deepmind", "lagrangebench", "jax-sph") where the file does not state it.

    Raises:
        DataError: if the file is missing or not JSON, or a key is missing or has a wrong value.
        ConfigError: if there is no such family.

    Warns:
        UserWarning: if the file names types otherwise than the family, which is then not used.
    """
    path = Path(folder) / METADATA_FILE
    return parse_metadata(load_json(path), path, family)


def parse_metadata(
    plain: Mapping[str, Any],
    where: Path,
    family: str | None = None,
    problems: list[str] | None = None,
    substitutes: Mapping[str, Any] | None = None,
) -> Metadata:
    """Validates the metadata in a JSON object.

    Args:
        plain: The object.
        where: Its file, for error messages.
        family: Meaning of the type ids where it does not state it.
        problems: Collects what is wrong with it; when left out, the first problem is raised.
        substitutes: Where problems are collected, values of the keys that are missing or wrong.

    Raises:
        DataError: if a key is missing or has a wrong value.
        ConfigError: if there is no such family.
    """
    check_plain(plain, where)
    keys = JsonKeys(where, plain, problems, substitutes)
    dim = keys.take("dim", parse_dim)
    types, static = _types(keys, family)
    length_key = next((key for key in _LENGTH_KEYS if key in keys.left), _LENGTH_KEYS[0])
    length = keys.peek(length_key, parse_count)
    keys.left.pop("sequence_length", None)
    return Metadata(
        bounds=keys.take("bounds", lambda value: parse_intervals(value, dim)),
        dt=keys.take("dt", parse_positive) * keys.peek("write_every", parse_positive, 1.0),
        dim=dim,
        sequence_length=length,
        particle_types=types,
        static_types=static,
        periodic=keys.take("periodic_boundary_conditions", lambda value: parse_flags(value, dim), (False,) * dim),
        domain=keys.take("domain", lambda value: parse_intervals(value, dim), None),
        gravity=keys.take("gravity", lambda value: parse_vector(value, dim), None),
        particle_volume=keys.take("particle_volume", parse_positive, None),
        densities=keys.take("densities", parse_densities, {}),
        fields=keys.take("fields", parse_field_names, ()),
        extra=keys.left,
    )


def _types(keys: JsonKeys, family: str | None) -> tuple[dict[int, str], frozenset[int]]:
    """Names of type ids and static ids, from the file or else the family."""
    fallback = find_family(family) if family is not None else None
    if fallback is None and keys.left.get("particle_types") is None and keys.problems is None:
        raise DataError(
            f"{keys.where}: the key 'particle_types' is missing, so the type ids have no meaning. Add it, e.g."
            f' "particle_types": {{"7": "goop"}}, or give the family: {", ".join(sorted(FAMILIES))}.'
        )
    types: dict[int, str] = keys.take("particle_types", parse_names, dict(fallback.types) if fallback else REQUIRED)
    names = fallback.types if fallback else types
    different = [f"{i} = {name}, not {names[i]}" for i, name in types.items() if names.get(i, name) != name]
    if different:
        warnings.warn(
            f"{keys.where} names its particle types itself ({'; '.join(different)}): the family {family} is not used.",
            stacklevel=4,
        )
    walls = frozenset(i for i, name in types.items() if name in STATIC_NAMES)
    return types, keys.take("static_types", parse_ids, fallback.static if fallback else walls)


def write_metadata(folder: Path, metadata: Metadata) -> None:
    """Writes `metadata.json` atomically, so that `read_metadata` returns equal metadata.

    Raises:
        DataError: if the file cannot be written, e.g. on a full disk.
    """
    solver_steps = metadata.extra.get("write_every", 1)
    plain: dict[str, Any] = {
        "bounds": metadata.bounds,
        "dt": metadata.dt / solver_steps,
        "dim": metadata.dim,
        "sequence_length": metadata.sequence_length,
        "particle_types": {str(i): name for i, name in sorted(metadata.particle_types.items())},
        "static_types": sorted(metadata.static_types),
        "periodic_boundary_conditions": metadata.periodic,
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
    """The JSON object in a dataset's `metadata.json`, not validated.

    Raises:
        DataError: if the file is missing, too large or too deep, or not a JSON object.
    """
    if not path.parent.is_dir():
        raise DataError(f"{path.parent}: no such folder. Give the folder that contains {METADATA_FILE}.")
    if not path.exists():
        raise DataError(f"{path}: no such file. A dataset needs this file, with bounds, dt, dim and sequence_length.")
    return parse_json(read_bounded(path, _BYTES), path)


def parse_json(text: str | bytes, where: Path | str) -> dict[str, Any]:
    """The JSON object of a text.

    Raises:
        DataError: if it is not JSON, not an object, or not plain (`check_plain`).
    """
    try:
        plain = json.loads(text)
    except (ValueError, RecursionError, MemoryError) as error:
        raise DataError(f"{where}: not valid JSON ({one_line(error)}).") from error
    if not isinstance(plain, dict):
        raise DataError(f"{where}: expected a JSON object, found {type(plain).__name__}.")
    check_plain(plain, where)
    return plain
