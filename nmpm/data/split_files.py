"""The files of a dataset's folder in the native layout: `train.h5`, `valid.h5` and `test.h5`, of which it has some."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from nmpm.errors import DataError

SPLITS = ("train", "valid", "test")
OTHER_NAMES = {
    "train": ("training", "trn"),
    "valid": ("val", "validation", "eval", "dev"),
    "test": ("testing", "tst"),
}

_NO_DATA = frozenset({"Thumbs.db", "desktop.ini", "__MACOSX"})


def is_no_data(name: str) -> bool:
    """Whether files and folders of a name are hidden, or left by a system's file manager or archiver."""
    return name.startswith(".") or name in _NO_DATA


def describe_others(folder: Path) -> str:
    """The HDF5 files that a folder has, in brackets, for messages; nothing if there are none."""
    names = sorted(file.name for file in folder.glob("*.h5"))
    return f" (beside it: {', '.join(names)})" if names else ""


def split_paths(folder: Path) -> Mapping[str, Path]:
    """The split files in a dataset's folder, by name, in the order train, valid, test."""
    paths = {name: Path(folder) / f"{name}.h5" for name in SPLITS}
    return {name: path for name, path in paths.items() if path.exists()}


def find_split(folder: Path, *names: str) -> Path:
    """The file of the first of the named splits that a folder has; if none, a DataError names those there are."""
    paths = split_paths(folder)
    for name in names:
        if name in paths:
            return paths[name]
    missing = " or ".join(f"{name}.h5" for name in names)
    renames = "".join(f" {rename}" for rename in split_renames(folder, names))
    raise DataError(f"{folder}: no {missing} there{describe_others(Path(folder))}.{renames}")


def split_renames(folder: Path, names: Iterable[str] = SPLITS) -> list[str]:
    """Advice to rename files such as `val.h5`, a sentence for each, where the named split is missing."""
    paths = split_paths(folder)
    return [
        f"Rename {other}.h5 to {name}.h5."
        for name in names
        for other in OTHER_NAMES[name]
        if name not in paths and (Path(folder) / f"{other}.h5").is_file()
    ]
