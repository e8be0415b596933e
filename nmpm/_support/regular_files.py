"""Checks that a path is a regular file: opening a FIFO would wait forever, reading a device would never end."""

from __future__ import annotations

import stat
from pathlib import Path

from nmpm.errors import DataError


def check_regular(path: Path) -> None:
    """Raises an error unless a path is a regular file, or a symbolic link to one.

    Raises:
        DataError: if there is nothing, or something else, such as a FIFO or a device.
    """
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise DataError(f"{path}: cannot be opened ({error.strerror}).") from error
    check_mode(path, mode)


def check_mode(path: Path, mode: int) -> None:
    """Raises an error unless the mode of a path's `stat` is that of a regular file.

    Raises:
        DataError: naming what it is, such as a FIFO or a device.
    """
    if not stat.S_ISREG(mode):
        raise DataError(f"{path}: is {_kind(mode)}, not a regular file. Give a file, or the folder that holds it.")


def _kind(mode: int) -> str:
    kinds = {
        stat.S_ISDIR: "a folder",
        stat.S_ISFIFO: "a FIFO",
        stat.S_ISSOCK: "a socket",
        stat.S_ISCHR: "a character device",
        stat.S_ISBLK: "a block device",
    }
    return next((name for matches, name in kinds.items() if matches(mode)), "something else")
