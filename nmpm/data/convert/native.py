"""The native layout, which LagrangeBench shares; converting it writes the user's options into its metadata.

And files of it alone: rollouts, predictions and whatever else brings its scene along, or has metadata beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from nmpm.data.convert.base import Facts, Options, Run, RunFiles, split_files
from nmpm.data.families import unambiguous_family
from nmpm.data.format import METADATA_FILE, SPLITS, Metadata, Split, Trajectory, read_metadata, split_paths
from nmpm.data.predictions import DESCRIPTION, read_description
from nmpm.errors import NmpmError


class Native(RunFiles):
    """A folder of train.h5, valid.h5, test.h5 with a `metadata.json`."""

    summary: ClassVar[str] = "LagrangeBench's HDF5 files with metadata.json, which nmpm reads as they are"
    patterns: tuple[str, ...] = tuple(f"{split}.h5" for split in SPLITS)
    fixed_names: ClassVar[bool] = True

    def recognises(self, path: Path) -> bool:
        return (path / METADATA_FILE).is_file() and super().recognises(path)

    def files(self, path: Path) -> dict[str, tuple[Path, ...]]:
        return {split: (file,) for split, file in split_paths(path).items()}

    def runs(self, file: Path) -> Sequence[Run]:
        return [Run(file, index) for index in range(len(Split(file)))]

    def facts(self, file: Path, options: Options) -> Facts:
        options = with_family(options, Split(file))
        note = (
            f"Particle types have the meaning of the {options.family} family where {METADATA_FILE} does not name them."
        )
        metadata = read_metadata(file.parent, options.family, options.types)
        return Facts(metadata, notes=(note,) if options.family else (), has_family=True)

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:  # noqa: ARG002
        return map(Split(file).read_with_fields, indices)


class NativeFiles(Native):
    """HDF5 files of the native layout whose trajectories describe their scene, or a split's file of a dataset."""

    summary: ClassVar[str] = "rollouts, predictions and other single HDF5 files of nmpm"
    patterns: tuple[str, ...] = ("*.h5", "*.vtkhdf")

    def recognises(self, path: Path) -> bool:
        files = self.files(path)
        return bool(files) and bool(file_metadata(Split(next(iter(files.values()))[0]), Options()))

    def files(self, path: Path) -> dict[str, tuple[Path, ...]]:
        return split_files(path, *self.patterns, unsplit="test")

    def facts(self, file: Path, options: Options) -> Facts:
        return Facts(file_metadata(Split(file), options), has_family=True)

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:
        for trajectory in super().read(file, indices, metadata):
            attributes = {name: value for name, value in trajectory.attributes.items() if name not in DESCRIPTION}
            yield replace(trajectory, attributes=attributes)


def file_metadata(split: Split, options: Options) -> Metadata:
    """The metadata of a file's scene, which its trajectories describe, or else those beside it.

    Of the options, only names of types are used, where the files have none.
    """
    attributes = split.attributes(0)
    if "scene" in attributes:
        return read_description(attributes, split.path, split.frames(0))[1]
    return read_metadata(split.path.parent, options.family, options.types)


def with_family(options: Options, split: Split) -> Options:
    """The options, with the family that the type ids of a file's first trajectory are of where nothing names them."""
    try:
        file_metadata(split, options)
    except NmpmError:
        return replace(options, family=options.family or unambiguous_family(split.particle_type(0).tolist()))
    return options
