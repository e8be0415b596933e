"""The native layout, which LagrangeBench shares; converting it writes the user's options into its metadata."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import ClassVar

from nmpm.data.convert.base import DatasetFormat, ForeignDataset, Options
from nmpm.data.format import METADATA_FILE, Split, Trajectory, read_metadata, split_paths


class Native(DatasetFormat):
    """A folder of train.h5, valid.h5, test.h5 with a `metadata.json`."""

    name: ClassVar[str] = "native"
    summary: ClassVar[str] = "LagrangeBench's HDF5 files with metadata.json, which nmpm reads as they are"

    def recognises(self, path: Path) -> bool:
        return (path / METADATA_FILE).is_file() and bool(split_paths(path))

    def open(self, path: Path, options: Options) -> ForeignDataset:
        metadata = options.apply_to(read_metadata(path, options.family))
        splits = {name: Split(file) for name, file in split_paths(path).items()}
        note = (
            f"Particle types have the meaning of the {options.family} family where {METADATA_FILE} does not name them."
        )
        return ForeignDataset(
            metadata=metadata,
            splits={name: partial(_read, split) for name, split in splits.items()},
            notes=(note,) if options.family else (),
            counts={name: len(split) for name, split in splits.items()},
        )


def _read(split: Split) -> Iterator[Trajectory]:
    return map(split.read_with_fields, range(len(split)))
