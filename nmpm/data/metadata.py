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
from nmpm._support.bounded_files import read_bounded
from nmpm._support.limits import METADATA_BYTES, TEXT_DEPTH
from nmpm._support.messages import one_line
from nmpm.data.families import FAMILIES, PADDING, STATIC_NAMES, find_family
from nmpm.data.json_keys import (
    JsonKeys,
    flags_parser,
    intervals_parser,
    parse_densities,
    parse_field_names,
    parse_ids,
    parse_names,
    parse_positive,
    parse_whole,
    vector_parser,
)
from nmpm.errors import DataError
from nmpm.scene import Interval

METADATA_FILE = "metadata.json"
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

    def check_types(self, particle_type: np.ndarray, where: str) -> None:
        """Raises an error if an array has an unknown type id.

        Raises:
            DataError: names the unknown ids, and `where` they occur.
        """
        unknown = sorted(set(np.unique(particle_type).tolist()) - set(self.particle_types))
        if unknown:
            known = ", ".join(f"{i} {name}" for i, name in sorted(self.particle_types.items()))
            raise DataError(
                f"{where}: unknown particle type {', '.join(map(str, unknown))} (known: {known}). Name it in"
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
    return metadata_from_dict(load_json(path), path, family)


def metadata_from_dict(plain: Mapping[str, Any], where: Path, family: str | None = None) -> Metadata:
    """Validates the metadata in a JSON object.

    Args:
        plain: The object; numbers, strings, lists and objects.
        where: Its file, for error messages.
        family: Meaning of the type ids where it does not state it.

    Raises:
        DataError: if a key is missing or has a wrong value.
        ConfigError: if there is no such family.
    """
    keys = JsonKeys(where, dict(plain))
    dim = keys.take("dim", parse_whole)
    if dim not in (1, 2, 3):
        raise keys.error("dim", dim, "1, 2 or 3")
    types, static = _types(keys, family)
    return Metadata(
        bounds=keys.take("bounds", intervals_parser(dim)),
        dt=keys.take("dt", parse_positive) * keys.peek("write_every", parse_positive, 1.0),
        dim=dim,
        sequence_length=_sequence_length(keys),
        particle_types=types,
        static_types=static,
        periodic=keys.take("periodic_boundary_conditions", flags_parser(dim), (False,) * dim),
        domain=keys.take("domain", intervals_parser(dim), None),
        gravity=keys.take("gravity", vector_parser(dim), None),
        particle_volume=keys.take("particle_volume", parse_positive, None),
        densities=keys.take("densities", parse_densities, {}),
        fields=keys.take("fields", parse_field_names, ()),
        extra=keys.left,
    )


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
    try:
        text = read_bounded(path, METADATA_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not valid JSON ({error}).") from error
    return parse_json(text, path)


def parse_json(text: str, where: Path | str) -> dict[str, Any]:
    """The JSON object of a text.

    Raises:
        DataError: if it is not JSON, not an object, or too deep.
    """
    try:
        plain = json.loads(text)
    except (ValueError, RecursionError, MemoryError) as error:
        raise DataError(f"{where}: not valid JSON ({one_line(error)}).") from error
    if not isinstance(plain, dict):
        raise DataError(f"{where}: expected a JSON object, found {type(plain).__name__}.")
    _check_depth(plain, where)
    return plain


def _check_depth(plain: Any, path: Path | str) -> None:
    level = [plain]
    for _ in range(TEXT_DEPTH):
        containers = [value for value in level if isinstance(value, list | dict)]
        level = [item for value in containers for item in (value.values() if isinstance(value, dict) else value)]
        if not level:
            return
    raise DataError(f"{path}: lists and objects are nested more than {TEXT_DEPTH} deep.")


def _types(keys: JsonKeys, family: str | None) -> tuple[dict[int, str], frozenset[int]]:
    fallback = find_family(family) if family is not None else None
    types = keys.take("particle_types", parse_names, dict(fallback.types) if fallback else None)
    if types is None:
        raise DataError(
            f"{keys.path}: the key 'particle_types' is missing, so the type ids have no meaning. Add it, e.g."
            f' "particle_types": {{"7": "goop"}}, or give the family: {", ".join(sorted(FAMILIES))}.'
        )
    if fallback is not None:
        _warn_of_unused(keys.path, str(family), types, fallback.types)
    walls = frozenset(i for i, name in types.items() if name in STATIC_NAMES)
    return types, keys.take("static_types", parse_ids, fallback.static if fallback else walls)


def _warn_of_unused(path: Path | str, family: str, types: Mapping[int, str], others: Mapping[int, str]) -> None:
    """Warn where a file's own names of type ids are not those of the family that was given."""
    different = [f"{i} = {name}, not {others[i]}" for i, name in types.items() if others.get(i, name) != name]
    if different:
        warnings.warn(
            f"{path} names its particle types itself ({'; '.join(different)}): the family {family} is not used.",
            stacklevel=4,
        )


def _sequence_length(keys: JsonKeys) -> int:
    key = next((key for key in _LENGTH_KEYS if key in keys.left), _LENGTH_KEYS[0])
    length: int = keys.take(key, parse_whole) if key == _LENGTH_KEYS[0] else keys.peek(key, parse_whole)
    return length
