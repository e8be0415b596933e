"""Downloads datasets from the Hugging Face hub into the cache; no code in them is executed."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path, PurePosixPath

from nmpm._support.atomic import lock_folder, new_folder
from nmpm._support.bounded_files import EXPANSION, FILE_NAME, ZIP_ERRORS, expansion_limit
from nmpm._support.messages import one_line
from nmpm._support.shipped import user_home
from nmpm.data.split_files import SPLITS
from nmpm.errors import ConfigError, DataError

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
