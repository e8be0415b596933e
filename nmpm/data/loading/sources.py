"""Where a datamodule's trajectories come from: a folder or the Hugging Face hub; `simulated` has the others."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

from nmpm.data.convert import Options, native_folder
from nmpm.data.convert.native import with_family
from nmpm.data.format import Metadata, Split, is_native, read_metadata
from nmpm.data.hub import hub_folder
from nmpm.data.loading.buffer import RecordingProvider
from nmpm.data.loading.recording import SplitRecordings
from nmpm.data.loading.window_plan import WindowPlan
from nmpm.data.scene_inference import infer_scene
from nmpm.data.split_files import find_split, split_paths, split_renames
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Reading, Scene

SourceName = Literal["disk", "simulate", "hub"]

_OPEN = "???"  # OmegaConf's for a value that is still to be given


@dataclass(frozen=True)
class DataSource(abc.ABC):
    """A source of trajectories. Files are read and datasets simulated on first use.

    Args:
        holds_out: Whether there is no valid split: the last of the training trajectories validates and is not trained
            on, or of a single one the end.
    """

    holds_out: bool = field(default=False, kw_only=True, repr=False)

    @property
    @abc.abstractmethod
    def description(self) -> str:
        """The data in words; simulated data are called simulated."""

    @property
    @abc.abstractmethod
    def folder(self) -> Path:
        """Folder in the native layout with at least the splits for evaluation; created on first use."""

    @property
    @abc.abstractmethod
    def scene(self) -> Scene:
        """The scene that the trajectories share."""

    @cached_property
    def metadata(self) -> Metadata:
        """The metadata of the folder."""
        return read_metadata(self.folder)

    def split(self, name: str) -> Split:
        """The file of the split "train", "valid" or "test"; raises a DataError if it is missing."""
        return Split(find_split(self.folder, name))

    def recordings(self, name: str, reading: Reading | None = None) -> SplitRecordings:
        """The trajectories of a split, as they are unless a reading is given.

        Raises:
            DataError: if its file is missing.
        """
        held_out = self.holds_out and name == "valid"
        split = self.split("train" if held_out else name)
        recordings = SplitRecordings(split, self.metadata, reading or Reading(self.scene))
        if not self.holds_out or name == "test":
            return recordings
        if len(recordings) > 1:
            return recordings.subset(recordings.indices[-1:] if held_out else recordings.indices[:-1])
        end = recordings.split.frames(0) * 4 // 5
        span = slice(end, None) if held_out else slice(end)
        return SplitRecordings(Split(split.path, span), self.metadata, recordings.reading)

    def training_data(self, length: int, reading: Reading, **plan: Any) -> tuple[RecordingProvider, WindowPlan]:
        """The trajectories to train on, and which of their windows make up which batch.

        Args:
            length: Frames of the model in a window; shorter trajectories are left out, with a warning that counts them.
            reading: How the data are read.
            plan: The other fields of `WindowPlan`, except `frames`.

        Raises:
            DataError: if all trajectories are shorter.
        """
        recordings = self.recordings("train", reading).with_frames(length, "a training window")
        return recordings, WindowPlan(frames=recordings.frames, length=reading.data_frames(length), **plan)


@dataclass(frozen=True)
class FolderSource(DataSource):
    """Recorded data: a dataset in the native layout, or in any format that `nmpm convert` reads.

    Data in the native layout are used as they are, except where they are resampled or smoothed: then a converted copy.
    """

    path: Path
    options: Options = field(default_factory=Options)

    @property
    def description(self) -> str:
        return self.path.name

    @cached_property
    def folder(self) -> Path:
        if not self.path.exists() or (
            is_native(self.path) and not self.options.changes_positions and self.options.files is None
        ):
            return self.path
        return native_folder(self.path, self.options)

    @cached_property
    def metadata(self) -> Metadata:
        facts = self._unapplied
        return facts.apply_to(read_metadata(self.folder, facts.family, facts.types))

    @cached_property
    def scene(self) -> Scene:
        return infer_scene(self.folder, self._unapplied)

    @cached_property
    def _unapplied(self) -> Options:
        """Options that the folder's metadata do not have yet: of a converted copy none."""
        if self.folder != self.path:
            return Options()
        paths = split_paths(self.folder)
        return with_family(self.options, Split(next(iter(paths.values())))) if paths else self.options

    def split(self, name: str) -> Split:
        paths = split_paths(self.folder)
        if self.folder != self.path and name not in paths:
            raise DataError(
                f"{self.path}: no trajectories for {name}, only for {', '.join(paths)}. Files or folders called {name}"
                " hold them."
            )
        return super().split(name)


def hold_out(source: DataSource) -> DataSource:
    """A source without a valid split that validates on training trajectories, which it says.

    Raises:
        DataError: if its folder has that split under another name.
    """
    from lightning.pytorch.utilities import rank_zero_info  # imported late: only trainings need it

    if source.holds_out:
        return source
    if split_renames(source.folder, ("valid",)):
        find_split(source.folder, "valid")  # raises, and says how to rename it
    source = replace(source, holds_out=True)
    held = source.recordings("valid")
    where = held.split.where(held.indices[0]).removeprefix(f"{held.split.path.parent}/")
    rank_zero_info(f"{source.description} has no valid split: {where}, validates and is not trained on.")
    return source


@dataclass(frozen=True)
class HubSource(FolderSource):
    """A dataset on the Hugging Face hub, downloaded on first use; `path` is its name."""

    @property
    def description(self) -> str:
        return f"{self.path} of the Hugging Face hub"

    @cached_property
    def folder(self) -> Path:
        return native_folder(hub_folder(str(self.path)), self.options)


def make_source(
    path: str | None, name: str | None, source: SourceName, options: Options, generate: Mapping[str, Any] | None
) -> DataSource:
    """The source that the arguments of `TrajectoryDataModule` mean; a ConfigError if they contradict each other."""
    if path == _OPEN and name is None:
        raise ConfigError("data.path is not set, the configuration leaves it open (???): give --data.path FOLDER.")
    if path is None and name is None:
        raise ConfigError(
            "Neither data.path nor data.name is set: give --data.path FOLDER, or --data.name and an embedded dataset"
            " (nmpm simulate --list)."
        )
    if source not in get_args(SourceName):
        raise ConfigError(f"source = {source} is not one of {', '.join(get_args(SourceName))}.")
    if path is not None and path != _OPEN:
        if source != "disk":
            raise ConfigError(
                f"source = {source} needs the `name` of a dataset, not the path {path}; for the path, --data.source"
                " disk."
            )
        return FolderSource(Path(path), options)
    if source == "hub":
        _refuse({"generate": generate}, f"the published dataset {name}")
        return HubSource(Path(str(name)), options)
    _refuse(vars(options), f"the simulated dataset {name}")
    from nmpm.data.loading.simulated import EmbeddedSource, SimulatedSource

    kind = SimulatedSource if source == "simulate" else EmbeddedSource
    return kind(str(name), dict(generate or {}))


def _refuse(arguments: Mapping[str, Any], data: str) -> None:
    wrong = [key for key, value in arguments.items() if value is not None]
    if wrong:
        mend = " ".join(f"--data.{key} null" for key in wrong)
        raise ConfigError(f"{', '.join(wrong)} cannot be combined with {data}; leave it out: {mend}.")
