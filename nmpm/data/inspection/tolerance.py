"""Reads what it can of datasets that `nmpm fit` and `nmpm convert` refuse, and lists what is wrong with them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nmpm.data.convert import Options, open_dataset
from nmpm.data.families import FAMILIES
from nmpm.data.format import (
    METADATA_FILE,
    SPLITS,
    Metadata,
    Split,
    Trajectory,
    find_split,
    split_paths,
    split_renames,
    write_metadata,
    write_split,
)
from nmpm.data.loading.sources import FolderSource
from nmpm.data.metadata import load_json, metadata_from_dict
from nmpm.errors import DataError

_KEYS = ("bounds", "dt", "write_every", "sequence_length", "particle_types", "static_types", "domain", "gravity",
         "periodic_boundary_conditions", "particle_volume", "densities", "fields")  # fmt: skip


def open_splits(folder: Path) -> tuple[dict[str, Split], list[str]]:
    """The splits of a folder that can be opened, and what is wrong with the others.

    Raises:
        DataError: if none can be opened.
    """
    splits: dict[str, Split] = {}
    findings = []
    for name, path in split_paths(folder).items():
        try:
            splits[name] = Split(path)
        except DataError as error:
            findings.append(str(error))
    if not splits and findings:
        raise DataError(findings[0])
    find_split(folder, *SPLITS)
    return splits, findings + [f"{folder}: {rename}" for rename in split_renames(folder)]


def guess_family(ids: Iterable[int], plain: Mapping[str, Any]) -> str:
    """The family of particle types that knows the most of the ids; LagrangeBench's where its metadata keys occur.

    Args:
        ids: Particle type ids that occur.
        plain: The metadata's JSON object.
    """
    names = ["deepmind", "lagrangebench", "jax-sph"]
    if "periodic_boundary_conditions" in plain:
        names = names[1:] + names[:1]
    return min(names, key=lambda name: len(set(ids) - set(FAMILIES[name].types)))


def with_guessed_family(origin: FolderSource) -> FolderSource:
    """The same dataset, with a guessed family where neither metadata nor user state the particle types."""
    try:
        plain = load_json(origin.folder / METADATA_FILE)
    except DataError:
        plain = {}
    if origin.stated.family is not None or plain.get("particle_types") is not None:
        return origin
    family = guess_family(_ids(open_splits(origin.folder)[0]), plain)
    return FolderSource(origin.folder, replace(origin.stated, family=family))


def tolerant_metadata(origin: FolderSource, splits: Mapping[str, Split]) -> tuple[Metadata, list[str]]:
    """The metadata, with values from the trajectories where the file has none or wrong ones; and what is wrong.

    Particle types without a name are called "type 9" and taken for moving.

    Args:
        origin: The dataset.
        splits: At least one.
    """
    findings: list[str] = []
    path = origin.folder / METADATA_FILE
    try:
        plain = load_json(path)
    except DataError as error:
        plain, findings = {}, [str(error)]
    metadata, wrong = _metadata(plain, path, origin.stated.family, next(iter(splits.values())))
    ids = _ids(splits)
    unknown = {i: f"type {i}" for i in ids if i not in metadata.particle_types}
    if unknown:
        findings.append(
            f"Particle type {', '.join(map(str, unknown))} is not in the metadata; it is taken for a moving material"
            f" here. To train on it, name it: nmpm convert FOLDER NEW --types {next(iter(unknown))}=sand."
        )
    return replace(metadata, particle_types=metadata.particle_types | unknown), findings + wrong


def _metadata(plain: Mapping[str, Any], path: Path, family: str | None, split: Split) -> tuple[Metadata, list[str]]:
    try:
        metadata = metadata_from_dict(plain, path, family)
        if metadata.dim == split.dim:
            return metadata, []
        findings = []
    except DataError as error:
        findings = [str(error)]
    if "dim" in plain and plain["dim"] != split.dim:
        findings.append(f"{path}: dim = {str(plain['dim'])[:40]}, but positions have {split.dim} axes.")
    low, high = _extent(split)
    usable: dict[str, Any] = {
        "dim": split.dim,
        "bounds": [[a, b] for a, b in zip(low, high, strict=True)],
        "dt": 1.0,
        "sequence_length": split.frames(0),
    }
    if family is None:
        usable["particle_types"] = {str(i): f"type {i}" for i in np.unique(split.particle_type(0)).tolist()}
    for key in _KEYS:
        try:
            metadata_from_dict(usable | {key: plain.get(key, usable.get(key))}, path, family)
        except DataError as error:
            if str(error) not in findings:
                findings.append(str(error))
        else:
            usable[key] = plain.get(key, usable.get(key))
    missing = [key for key in ("bounds", "dt") if key not in plain]
    if missing:
        findings.append(f"{path}: without {' and '.join(missing)}, lengths and times here are the file's own units.")
    return metadata_from_dict(usable, path, family), findings


def _extent(split: Split) -> tuple[list[float], list[float]]:
    try:
        position = split.read(0).position
        low, high = position.min(axis=(0, 1)), position.max(axis=(0, 1))
    except DataError:
        low, high = np.zeros(split.dim), np.ones(split.dim)
    return low.tolist(), np.where(high > low, high, low + 1).tolist()


def _ids(splits: Mapping[str, Split]) -> list[int]:
    """All particle type ids that occur, ascending."""
    found: set[int] = set()
    for split in splits.values():
        for index in range(len(split)):
            found.update(np.unique(split.particle_type(index)).tolist())
    return sorted(found)


def convert_readable(path: Path, folder: Path, format_name: str | None, options: Options) -> list[str]:
    """Converts the trajectories of a foreign dataset up to the first damaged one of each split.

    Args:
        path: A file or folder.
        folder: A folder that does not exist yet.
        format_name: Name of the format; detected when left out.
        options: Facts that the files do not state.

    Returns:
        What is wrong with the others, as sentences.

    Raises:
        DataError: if no trajectory can be read.
        ConfigError: if there is no format of that name, or an option is invalid.
    """
    findings: list[str] = []
    dataset = open_dataset(path, format_name, options)
    for name, split in dataset.splits.items():
        trajectories = _readable(split, findings)
        first = next(trajectories, None)
        if first is not None:
            write_split(folder / f"{name}.h5", _chain(first, trajectories))
    if not split_paths(folder):
        raise DataError(findings[0] if findings else f"{path}: no trajectory there.")
    write_metadata(folder, replace(dataset.metadata, sequence_length=dataset.metadata.sequence_length or 1))
    return findings


def _readable(split: Iterable[Trajectory], findings: list[str]) -> Iterator[Trajectory]:
    try:
        yield from split
    except DataError as error:
        findings.append(f"{error} Trajectories after it are not read.")


def _chain(first: Trajectory, others: Iterator[Trajectory]) -> Iterator[Trajectory]:
    yield first
    yield from others
