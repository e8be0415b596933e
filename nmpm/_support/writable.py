"""Checks, before the work, that files can be written."""

from __future__ import annotations

import tempfile
from pathlib import Path


def file_obstacle(path: Path) -> str:
    """Why a file cannot be written, in words; empty if it can."""
    if path.is_dir():
        return "it is a folder; name a file."
    if not path.parent.is_dir():
        return f"the folder {path.parent} does not exist; create it first."
    return folder_obstacle(path.parent)


def folder_obstacle(folder: Path) -> str:
    """Why nothing can be written into an existing folder, in words; empty if it can."""
    try:
        # Unlike a look at the permission bits, this also finds read-only and full file systems.
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return f"the folder {folder} is not writable ({error.strerror})."
