"""Where trajectories come from: a folder, or the Hugging Face hub, whose files are downloaded and never executed.

`nmpm.data.simulated_sources` has those that are simulated.
"""

from __future__ import annotations

import abc
import shutil
import zipfile
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

from nmpm._support.atomic import lock_folder, new_folder
from nmpm._support.bounded_files import EXPANSION, FILE_NAME, ZIP_ERRORS, expansion_limit
from nmpm._support.messages import one_line
from nmpm._support.shipped import user_home
from nmpm.data.batches import RecordingProvider, WindowPlan
from nmpm.data.convert import Options, native_folder
from nmpm.data.convert.native import with_family
from nmpm.data.format import SPLITS, Metadata, Split, find_split, is_native, read_metadata, split_paths, split_renames
from nmpm.data.recordings import SplitRecordings
from nmpm.data.scene_inference import infer_scene
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Reading, Scene

REPOSITORY = "iSach/NeuralMPM"
"""Repository of names without an owner: the datasets of the paper's authors."""

_DATA = (".h5", ".json", ".npz", ".tfrecord", ".zst")


def hub_folder(name: str) -> Path:
    """The folder of a published dataset, downloaded now if it is not in the cache.

    Archives are unpacked; only data files with plain names are extracted.

    Args:
        name: "WaterRamps" of `iSach/NeuralMPM`, or "owner/repository" with or without "/folder".

    Raises:
        ConfigError: if the name is malformed.
        DataError: if it cannot be downloaded.
    """
    repository, folder = _parse_name(name)
    downloaded = _fetch(repository, folder)
    archives = sorted(downloaded.rglob("*.zip"))
    if not archives:
        return downloaded
    unpacked = user_home() / "hub" / repository.replace("/", "--") / (folder or "all")
    with lock_folder(unpacked.parent):
        if not unpacked.is_dir():
            _unpack(downloaded, archives, unpacked)
    # In archives the splits may be one level deeper.
    for candidate in (unpacked, *sorted(item for item in unpacked.iterdir() if item.is_dir())):
        if any((candidate / split).is_dir() or (candidate / f"{split}.h5").is_file() for split in SPLITS):
            return candidate
    return unpacked


def _parse_name(name: str) -> tuple[str, str]:
    parts = name.strip("/").split("/")
    if len(parts) > 3 or not all(FILE_NAME.fullmatch(part) for part in parts):
        raise ConfigError(
            f"{name!r} is not the name of a dataset on the hub: give a folder of {REPOSITORY}, such as WaterRamps, or"
            " owner/repository or owner/repository/folder."
        )
    if len(parts) == 1:
        return REPOSITORY, parts[0]
    return "/".join(parts[:2]), parts[2] if len(parts) == 3 else ""


def _fetch(repository: str, folder: str) -> Path:
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError, RepositoryNotFoundError

    wanted = f"{repository}/{folder}" if folder else repository
    try:
        snapshot = snapshot_download(repository, repo_type="dataset", allow_patterns=f"{folder}/*" if folder else None)
    except RepositoryNotFoundError as error:
        raise DataError(f"{wanted}: the hub has no dataset {repository}.") from error
    except (LocalEntryNotFoundError, HfHubHTTPError, OSError) as error:
        raise DataError(
            f"{wanted}: not in the cache, and cannot be downloaded from the Hugging Face hub ({one_line(error, 160)})."
            f" On a machine with a connection, run `hf download --repo-type dataset {repository}"
            f"{f' --include {folder}/*' if folder else ''} --local-dir data`, unpack archives, copy"
            " the folder here, and give it as the path."
        ) from error
    downloaded = Path(snapshot) / folder
    if not downloaded.is_dir():
        raise DataError(f"{wanted}: the dataset {repository} has no folder {folder}.")
    return downloaded


def _unpack(downloaded: Path, archives: list[Path], target: Path) -> None:
    """Copies the data files of the archives, and those beside them, into a folder that appears when it is complete."""
    try:
        with new_folder(target) as new:
            for archive in archives:
                _unpack_one(archive, new / archive.parent.relative_to(downloaded))
            for file in downloaded.rglob("*"):
                if file.suffix in _DATA:
                    copy = new / file.relative_to(downloaded)
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(file, copy)
            if not any(new.iterdir()):
                raise DataError(f"{target}: cannot be unpacked (no data files in {downloaded}).")
    except ZIP_ERRORS as error:
        raise DataError(f"{target}: cannot be unpacked ({one_line(error, 160)}).") from error


def _unpack_one(archive: Path, target: Path) -> None:
    with zipfile.ZipFile(archive) as file:
        unpacked = sum(item.file_size for item in file.infolist())
        if unpacked > expansion_limit(archive.stat().st_size):
            raise DataError(f"{archive}: unpacks to {unpacked:,} bytes, more than {EXPANSION} times its size.")
        for item in file.infolist():
            path = PurePosixPath(item.filename)
            if item.is_dir() or path.suffix not in _DATA or "__MACOSX" in path.parts:
                continue
            if path.is_absolute() or not all(FILE_NAME.fullmatch(part) for part in path.parts):
                raise DataError(f"{archive}: does not unpack {item.filename!r}, as the path may leave the folder.")
            unpacked_file = target.joinpath(*path.parts)
            unpacked_file.parent.mkdir(parents=True, exist_ok=True)
            with file.open(item) as packed, unpacked_file.open("wb") as out:
                shutil.copyfileobj(packed, out)


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
