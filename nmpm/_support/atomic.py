"""Files and folders that others see whole or not at all; locks; and whether a path can be written."""

from __future__ import annotations

import errno
import logging
import os
import platform
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path

from filelock import FileLock, Timeout

from nmpm.errors import DataError

_STEM = 40
"""Characters of a file's name that its temporary name begins with."""

_log = logging.getLogger(__name__)


def _temporary_path(path: Path) -> Path:
    """A hidden file beside `path` to write first; a long name is cut, so that the whole fits."""
    return path.with_name(f".{path.stem[:_STEM]}.{secrets.token_hex(6)}.part{path.suffix}")


def temporary_files(folder: Path) -> Iterator[Path]:
    """Files that `atomic_write` is writing in a folder, or was writing when its process was killed."""
    return folder.glob(".*.*.part*")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`, of the same suffix, and renames it to `path` on success.

    Creates the folder if it does not exist. Readers of `path` see the old file or the complete new one; after an
    exception the temporary file is deleted and `path` is unchanged.

    Raises:
        OSError: naming `path` where the system names no file, as on a full disk, or the temporary one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary_path(path)
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
    """Yields an empty folder beside `path`, and renames it to `path` on success; after an exception it is deleted.

    Raises:
        OSError: if `path` is there by then, unless it is an empty folder.
    """
    with _empty_folders(path) as (new, _):
        yield new
        os.replace(new, path)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yields an empty folder beside `path`, and renames it to `path` on success, in place of a former one.

    Nothing of a former folder stays that the caller does not copy. After an exception `path` is unchanged. A process
    that is killed between the two renames that replacing takes leaves no folder at `path`: the next one that writes it
    brings the former one back first.
    """
    with _empty_folders(path) as (new, former):
        yield new
        try:
            if path.exists():
                os.replace(path, former)
            os.replace(new, path)
        except BaseException:  # an interrupt too
            _bring_back(former, path)
            raise


@contextmanager
def _empty_folders(path: Path) -> Iterator[tuple[Path, Path]]:
    """An empty folder beside `path` to fill, and where the former folder goes; one process of a machine at a time.

    What a killed process left there is cleared first. Some file systems, such as sshfs, lock within one machine only,
    so that each machine has folders of its own.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # A name that is cut may be that of several paths; their digests differ.
    stem = f".{path.name[:_STEM]}.{sha256(path.name.encode()).hexdigest()[:8]}.{platform.node()}"
    new, former, lock = (path.with_name(f"{stem}.{kind}") for kind in ("new", "former", "lock"))
    held = FileLock(lock)
    with suppress(OSError):  # a file system without locks
        _acquire(held, path)
    try:
        _bring_back(former, path)
        for folder in (new, former):
            shutil.rmtree(folder, ignore_errors=True)
        new.mkdir()
        yield new, former
    finally:
        for folder in (new, former):
            shutil.rmtree(folder, ignore_errors=True)
        lock.unlink(missing_ok=True)  # while it is held: who waits for it starts over with a new file
        held.release()


def _bring_back(former: Path, path: Path) -> None:
    if former.exists() and not path.exists():
        os.replace(former, path)


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lets one process, and one of its threads, at a time work in a folder, which is created if missing.

    The lock is the operating system's: it ends with the process, however that ends. Raises DataError if the folder
    cannot be created or written.
    """
    lock = FileLock(folder / ".lock")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _acquire(lock, folder)
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written ({error.strerror}). Correct the permissions, or choose another folder; the"
            " environment variable NMPM_HOME sets the folder of all that nmpm keeps."
        ) from error
    try:
        yield
    finally:
        lock.release()


def _acquire(lock: FileLock, path: Path) -> None:
    try:
        lock.acquire(blocking=False)
    except Timeout:
        _log.warning("Another process works in %s; waiting for it to finish.", path)
        lock.acquire()


def file_obstacle(path: Path) -> str:
    """Why a file cannot be written, in words; empty if it can."""
    if obstacle := name_obstacle(path):
        return obstacle
    if path.is_dir():
        return "it is a folder; name a file."
    if obstacle := name_obstacle(_temporary_path(path)):
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
