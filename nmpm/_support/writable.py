"""Checks, before the work, that files can be written."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

from nmpm._support.atomic import temporary_path


def file_obstacle(path: Path) -> str:
    """Why a file cannot be written, in words; empty if it can."""
    if obstacle := name_obstacle(path):
        return obstacle
    if path.is_dir():
        return "it is a folder; name a file."
    if obstacle := name_obstacle(temporary_path(path)):
        return obstacle
    if path.parent.is_file():
        return f"{path.parent} is a file, not a folder."
    if not path.parent.is_dir():
        return f"the folder {path.parent} does not exist; create it first."
    return folder_obstacle(path.parent)


def name_obstacle(path: Path) -> str:
    """Why the file system has no such names, in words; empty if it has."""
    try:
        os.lstat(path)
    except ValueError as error:
        return f"it is not a file's name ({error})."
    except OSError as error:
        if error.errno in (errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL):
            return f"{os.strerror(error.errno).lower()}."
    return ""


def folder_obstacle(folder: Path) -> str:
    """Why nothing can be written into an existing folder, in words; empty if it can."""
    try:
        # Unlike a look at the permission bits, this also finds read-only and full file systems.
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return f"the folder {folder} is not writable ({error.strerror})."
