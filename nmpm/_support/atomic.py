"""Atomic writing of files and folders."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

STEM = 40
"""Characters of a file's name that its temporary name begins with."""


def temporary_path(path: Path) -> Path:
    """The hidden file beside `path` that this process writes first; a long name is cut, so that the whole fits."""
    return path.with_name(f".{path.stem[:STEM]}.{os.getpid()}.part{path.suffix}")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`, of the same suffix, and renames it to `path` on success.

    Creates the folder if it does not exist. Readers of `path` see the old file or the complete new one; after an
    exception the temporary file is deleted and `path` is unchanged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_path(path)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yields a new, empty folder beside `path`, and renames it to `path` on success, in place of a former one.

    Nothing of a former folder stays that the caller does not copy. After an exception the new one is deleted and `path`
    is unchanged. A process that is killed leaves a hidden folder beside `path`; between the two renames that replacing
    takes, it holds the former folder.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name[:STEM]}.", dir=path.parent) as temporary:
        new, former = Path(temporary) / "new", Path(temporary) / "former"
        new.mkdir()
        yield new
        if path.exists():
            os.replace(path, former)
        try:
            os.replace(new, path)
        except OSError:
            if former.exists():
                os.replace(former, path)
            raise
