"""The native layout, which LagrangeBench shares; converting it writes the user's options into its metadata.

And files of it alone: rollouts, predictions and whatever else brings its scene along, or has metadata beside it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

from nmpm.data.convert.base import DatasetFormat, ForeignDataset, Options, split_files
from nmpm.data.described import DESCRIPTION, described_metadata
from nmpm.data.format import METADATA_FILE, Metadata, Split, Trajectory, read_metadata
from nmpm.data.metadata import unambiguous_family
from nmpm.data.split_files import split_paths
from nmpm.errors import DataError, NmpmError

_PATTERNS = ("*.h5", "*.vtkhdf")


class Native(DatasetFormat):
    """A folder of train.h5, valid.h5, test.h5 with a `metadata.json`."""

    name: ClassVar[str] = "native"
    summary: ClassVar[str] = "LagrangeBench's HDF5 files with metadata.json, which nmpm reads as they are"

    def recognises(self, path: Path) -> bool:
        return (path / METADATA_FILE).is_file() and bool(split_paths(path))

    def open(self, path: Path, options: Options) -> ForeignDataset:
        splits = {name: Split(file) for name, file in split_paths(path).items()}
        options = with_family(options, next(iter(splits.values())))
        metadata = options.apply_to(read_metadata(path, options.family, options.types))
        note = (
            f"Particle types have the meaning of the {options.family} family where {METADATA_FILE} does not name them."
        )
        return ForeignDataset(
            metadata=metadata,
            splits={name: partial(_read, split) for name, split in splits.items()},
            notes=(note,) if options.family else (),
            counts={name: len(split) for name, split in splits.items()},
        )


class NativeFiles(DatasetFormat):
    """HDF5 files of the native layout whose trajectories describe their scene, or a split's file of a dataset."""

    name: ClassVar[str] = "native-files"
    summary: ClassVar[str] = "rollouts, predictions and other single HDF5 files of nmpm"

    def recognises(self, path: Path) -> bool:
        files = split_files(path, *_PATTERNS)
        return bool(files) and bool(file_metadata(Split(next(iter(files.values()))[0]), Options()))

    def open(self, path: Path, options: Options) -> ForeignDataset:
        splits = {name: [Split(file) for file in files] for name, files in split_files(path, *_PATTERNS).items()}
        if not splits:
            raise DataError(f"{path}: no file {' or '.join(_PATTERNS)} there.")
        return ForeignDataset(
            metadata=options.apply_to(file_metadata(next(iter(splits.values()))[0], options)),
            splits={name: partial(_read_files, files) for name, files in splits.items()},
            counts={name: sum(map(len, files)) for name, files in splits.items()},
        )


def file_metadata(split: Split, options: Options) -> Metadata:
    """The metadata of a file's scene, which its trajectories describe, or else those beside it.

    Of the options, only names of types are used, where the files have none.
    """
    attributes = split.attributes(0)
    if "scene" in attributes:
        return described_metadata(attributes, split.path, split.frames(0))
    return read_metadata(split.path.parent, options.family, options.types)


def with_family(options: Options, split: Split) -> Options:
    """The options, with the family that the type ids of a file's first trajectory are of where nothing names them."""
    try:
        file_metadata(split, options)
    except NmpmError:
        return replace(options, family=options.family or unambiguous_family(split.particle_type(0)))
    return options


def _read_files(splits: list[Split]) -> Iterator[Trajectory]:
    for split in splits:
        for trajectory in _read(split):
            attributes = {name: value for name, value in trajectory.attributes.items() if name not in DESCRIPTION}
            yield replace(trajectory, attributes=attributes)


def _read(split: Split) -> Iterator[Trajectory]:
    return map(split.read_with_fields, range(len(split)))
