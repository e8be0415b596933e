"""Atomic writing of files and folders."""

from __future__ import annotations

import fcntl
import os
import platform
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from hashlib import sha256
from pathlib import Path

STEM = 40
"""Characters of a file's name that its temporary name begins with."""

NEW, FORMER, LOCK = "new", "former", "lock"
"""Within the temporary folder beside one that is written: what is to appear, what it takes the place of, and the file
that its process holds a lock on, which ends with the process."""


def temporary_path(path: Path) -> Path:
    """A hidden file beside `path` to write first; a long name is cut, so that the whole fits.

    The number of the process lets its files be found when it was killed. The random number tells apart processes of
    containers that share the folder and number their processes alike.
    """
    return path.with_name(f".{path.stem[:STEM]}.{os.getpid()}.{secrets.token_hex(4)}.part{path.suffix}")


def temporary_files(folder: Path, process: int | str = "*") -> Iterator[Path]:
    """Files of a folder that a process, of this number or any, was writing when it was killed, or is writing."""
    return folder.glob(f".*.{process}.*.part*")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`, of the same suffix, and renames it to `path` on success.

    Creates the folder if it does not exist. Readers of `path` see the old file or the complete new one; after an
    exception the temporary file is deleted and `path` is unchanged.

    Raises:
        OSError: naming `path` where the system names no file, as on a full disk, or the temporary one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_path(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary), temporary):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yields an empty folder beside `path`, and renames it to `path` on success.

    After an exception it is deleted. What a killed process of this machine left is deleted by the next one that writes
    the same path.

    Raises:
        OSError: if `path` is there by then, unless it is an empty folder.
    """
    with _workplace(path) as place:
        yield place / NEW
        os.replace(place / NEW, path)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yields an empty folder beside `path`, and renames it to `path` on success, in place of a former one.

    Nothing of a former folder stays that the caller does not copy. After an exception `path` is unchanged. A process of
    this machine that is killed between the two renames that replacing takes leaves no folder at `path`: the next one
    that writes it brings the former one back first.
    """
    with _workplace(path) as place:
        yield place / NEW
        try:
            if path.exists():
                os.replace(path, place / FORMER)
            os.replace(place / NEW, path)
        except BaseException:  # an interrupt too, after which the temporary folder is deleted
            if (place / FORMER).exists() and not path.exists():
                os.replace(place / FORMER, path)
            raise


@contextmanager
def _workplace(path: Path) -> Iterator[Path]:
    """A hidden folder beside `path` with an empty folder `NEW`, after leftovers of killed processes are cleared."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # A name that is cut may be that of several paths; their digests differ. Some file systems, such as sshfs, lock
    # within one machine only, so that each machine clears what it has left itself.
    stem = f".{path.name[:STEM]}.{sha256(path.name.encode()).hexdigest()[:8]}.{platform.node()}."
    for left in path.parent.glob(f"{escape(stem)}*"):
        with suppress(OSError), (left / LOCK).open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises while the folder's process lives
            if (left / FORMER).exists() and not path.exists():
                os.replace(left / FORMER, path)
            shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=stem, dir=path.parent, ignore_cleanup_errors=True) as name:
        place = Path(name)
        (place / NEW).mkdir()
        with (place / "unlocked").open("w") as file:
            with suppress(OSError):  # a file system without locks, on which nothing is cleared
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.replace(place / "unlocked", place / LOCK)
            yield place
