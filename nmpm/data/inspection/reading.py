"""Opens datasets that `nmpm fit` may refuse: problems are collected, and values from the trajectories stand in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nmpm._support.messages import one_line
from nmpm.data.format import METADATA_FILE, Metadata, Split
from nmpm.data.loading.sources import FolderSource
from nmpm.data.metadata import FAMILIES
from nmpm.data.metadata_json import load_json, parse_metadata
from nmpm.data.split_files import SPLITS, find_split, split_paths, split_renames
from nmpm.data.statistics import extent_of
from nmpm.errors import ConfigError, DataError


@dataclass(frozen=True)
class OpenedDataset:
    """A dataset, as far as it can be read."""

    source: FolderSource  # with a guessed family where neither metadata nor user state the particle types
    splits: dict[str, Split]  # those that can be opened; at least one
    metadata: Metadata  # with values from the trajectories where the file has none; types without a name move
    problems: list[str]
    wrong_metadata: bool  # whether some of the problems are about the metadata


def open_dataset(source: FolderSource) -> OpenedDataset:
    """Opens a dataset as far as it can be read; raises a DataError if no split can be opened."""
    folder, problems = source.folder, list[str]()
    if source.options.changes_positions:
        source = FolderSource(folder, source.options.of_converted)
    splits: dict[str, Split] = {}
    for name, path in split_paths(folder).items():
        try:
            splits[name] = Split(path)
        except DataError as error:
            problems.append(str(error))
    if not splits and problems:
        raise DataError(problems[0])
    find_split(folder, *SPLITS)
    problems += [f"{folder}: {rename}" for rename in split_renames(folder)]
    try:
        plain: dict[str, Any] | None = load_json(folder / METADATA_FILE)
    except DataError as error:
        plain = None
        problems.append(str(error))
    ids = sorted({i for split in splits.values() for n in range(len(split)) for i in split.particle_type(n).tolist()})
    if source.options.family is None and (plain or {}).get("particle_types") is None:
        source = FolderSource(folder, replace(source.options, family=guess_family(ids, plain or {})))
    metadata, wrong = _read_metadata(source, plain, next(iter(splits.values())), ids)
    try:
        # A gravity that contradicts the file's is a problem that the scene reports.
        gravity = source.options.gravity if metadata.gravity is None else None
        metadata = replace(source.options, gravity=gravity).apply_to(metadata)
    except ConfigError as error:
        wrong.append(str(error))
    if unknown := metadata.unknown_types(np.array(ids)):
        metadata = replace(metadata, particle_types=metadata.particle_types | {i: f"type {i}" for i in unknown})
        problems.append(
            f"Particle type {', '.join(map(str, unknown))} is not in the metadata; it is taken for a moving material"
            f" here. To train on it, name it: nmpm convert FOLDER NEW --types {unknown[0]}=sand."
        )
    return OpenedDataset(source, splits, metadata, problems + wrong, bool(wrong or unknown))


def guess_family(ids: Iterable[int], plain: Mapping[str, Any]) -> str:
    """The family that knows the most of the type ids; of equal ones LagrangeBench's where its metadata keys occur."""
    names = ["deepmind", "lagrangebench", "jax-sph"]
    if "periodic_boundary_conditions" in plain:
        names = names[1:] + names[:1]
    return min(names, key=lambda name: len(set(ids) - set(FAMILIES[name].types)))


def _read_metadata(
    source: FolderSource, stated: dict[str, Any] | None, split: Split, ids: list[int]
) -> tuple[Metadata, list[str]]:
    path, plain, problems = source.folder / METADATA_FILE, stated or {}, list[str]()
    if plain.get("dim") not in (None, split.dim):
        problems.append(f"{path}: dim = {one_line(plain['dim'], 40)}, but positions have {split.dim} axes.")
        plain = plain | {"dim": split.dim}
    try:
        extent = extent_of(split.read(0).position).intervals
    except DataError:
        extent = ((0.0, 1.0),) * split.dim
    substitutes = {
        "dim": split.dim,
        "bounds": tuple((low, high if high > low else low + 1) for low, high in extent),
        "dt": 1.0,
        "sequence_length": split.frames(0),
        "particle_types": {i: f"type {i}" for i in ids},
    }
    # Of a file that cannot be read, no key needs to be named.
    family, unread = source.options.family, stated is None
    metadata = parse_metadata(plain, path, family, None, [] if unread else problems, substitutes)
    if missing := [key for key in ("bounds", "dt") if key not in plain]:
        problems.append(f"{path}: without {' and '.join(missing)}, lengths and times here are the file's own units.")
    return metadata, problems
