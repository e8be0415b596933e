"""Reads HDF5 files from untrusted sources, and writes HDF5 files to disks that may be full.

An HDF5 file can refer to other files (external links, external storage, virtual datasets), so that the bytes of any
file would be read as positions; `check_self_contained` refuses these. HDF5 crashes the process when a write fails, so
`writable_hdf5` gives it a file whose writes never fail and reports the error afterwards.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from io import FileIO
from pathlib import Path
from typing import Any

import h5py

from nmpm._support.atomic import atomic_write
from nmpm._support.limits import HDF5_DEPTH, HDF5_OBJECTS, expansion_limit
from nmpm._support.regular_files import check_regular
from nmpm.errors import DataError, NmpmError

_ERRORS = (OSError, RuntimeError, LookupError, TypeError, ValueError, ArithmeticError, AttributeError, MemoryError)
"""What h5py raises on damaged files."""

_LOCK_SIGNS = ("unable to lock file", "file locking")
"""In HDF5's messages on files that another program, or another part of this one, has locked."""


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Opens an HDF5 file for reading.

    Raises:
        DataError: if it is not a regular file, is locked, or HDF5 cannot read it; names the file.
    """
    check_regular(path)
    try:
        with h5py.File(path, "r") as file:
            yield file
    except NmpmError:
        raise
    except _ERRORS as error:
        raise _read_error(path, error) from error


def _read_error(path: Path, error: Exception) -> DataError:
    reason = " ".join(str(error).split())[:200]
    if any(sign in reason for sign in _LOCK_SIGNS):
        cause = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else reason
        return DataError(
            f"{path}: is locked ({cause}). Close the program that has it open, e.g. a notebook that writes it; if there"
            " is none, as on some network or read-only disks, set HDF5_USE_FILE_LOCKING=FALSE."
        )
    if isinstance(error, PermissionError):
        return DataError(f"{path}: cannot be read (permission denied). Correct its permissions.")
    return DataError(f"{path}: cannot be read as HDF5 ({reason}). Is it complete? Copy, download or generate it again.")


def check_self_contained(file: Any, path: Path) -> None:
    """Raises an error if an open HDF5 file takes content from other files, or has too many or too deep groups.

    Raises:
        DataError: names the file and the link, group or dataset.
    """
    # By hand: h5py's `visititems` recurses in C, and crashes the process in deep groups.
    pending, count = [("", file, 0)], 0
    while pending:
        place, group, depth = pending.pop()
        for name in group:
            count += 1
            where = f"{place}{name}"
            if count > HDF5_OBJECTS:
                raise DataError(f"{path}: has more than {HDF5_OBJECTS:,} groups and datasets.")
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                raise _elsewhere_error(path, f"{where!r} is an external link to {link.filename!r}")
            # A soft link leads to an object that is visited by its other name, or nowhere.
            item = group[name] if isinstance(link, h5py.HardLink) else None
            if isinstance(item, h5py.Group):
                if depth >= HDF5_DEPTH:
                    raise DataError(f"{path}: {where[:100]!r} is nested more than {HDF5_DEPTH} groups deep.")
                pending.append((f"{where}/", item, depth + 1))
            elif isinstance(item, h5py.Dataset):
                _check_stored_here(item, where, path)


def _check_stored_here(dataset: Any, name: str, path: Path) -> None:
    if dataset.external:
        raise _elsewhere_error(path, f"{name!r} is stored in another file, {dataset.external[0][0]!r}")
    if dataset.is_virtual:
        raise _elsewhere_error(path, f"{name!r} is a virtual dataset")


def _elsewhere_error(path: Path, found: str) -> DataError:
    return DataError(f"{path}: {found}; content of other files is not read. Copy it into this file.")


def check_stored_size(dataset: Any, where: str) -> None:
    """Refuses a dataset that declares far more than its file stores, before anything of its size is allocated.

    Raises:
        DataError: naming `where` and both sizes.
    """
    declared = math.prod(dataset.shape) * dataset.dtype.itemsize
    chunk = math.prod(dataset.chunks or (0,)) * dataset.dtype.itemsize
    stored = int(dataset.id.get_storage_size())
    if max(declared, chunk) > expansion_limit(stored):
        raise DataError(
            f"{where}: has the shape {dataset.shape}, {max(declared, chunk):,} bytes, but only {stored:,} bytes are"
            " stored. Is the file complete? Copy, download or generate it again."
        )


@contextmanager
def writable_hdf5(path: Path, **options: Any) -> Iterator[tuple[Any, Callable[[], None]]]:
    """Opens a new HDF5 file, which replaces `path` once it is complete.

    Args:
        path: The file.
        options: Of `h5py.File`.

    Yields:
        The open HDF5 file, and a function that raises the error of an earlier write; call it after each large write.

    Raises:
        DataError: if a write fails, e.g. because the disk is full; `path` is then as it was.
    """
    with _open_atomically(path) as raw:
        target = _NeverFailingFile(raw.fileno())

        def check() -> None:
            if target.error is not None:
                raise _write_error(path, target.error, target.unwritten_bytes) from target.error

        with h5py.File(target, "w", **options) as file:
            yield file, check
        check()


@contextmanager
def _open_atomically(path: Path) -> Iterator[FileIO]:
    """Opens a temporary file that replaces `path` on success."""
    with ExitStack() as stack:
        try:
            part = stack.enter_context(atomic_write(path))
            raw = stack.enter_context(part.open("w+b", buffering=0))
        except OSError as error:
            raise DataError(
                f"{path}: cannot be written ({error.strerror}). Correct the permissions, or choose another folder."
            ) from error
        yield raw


def _write_error(path: Path, error: OSError, missing: int) -> DataError:
    free = shutil.disk_usage(next(folder for folder in path.absolute().parents if folder.is_dir())).free
    return DataError(
        f"{path}: cannot be written ({error.strerror}): at least {missing} more bytes are needed, {free} are free on"
        " its disk. Free space or choose another folder."
    )


class _NeverFailingFile:
    """The file object that h5py writes to; content that cannot be written is kept in memory, and the error noted.

    Reads return that content too, so that HDF5 can close the file in order. The caller stops after the first error, so
    that no more than one trajectory and HDF5's caches are kept.

    Args:
        descriptor: Of a file that is open for reading and writing.
    """

    def __init__(self, descriptor: int) -> None:
        self.error: OSError | None = None
        self._descriptor, self._position = descriptor, 0
        self._unwritten: list[tuple[int, bytes]] = []

    @property
    def unwritten_bytes(self) -> int:
        """Size of what could not be written."""
        return sum(len(content) for _, content in self._unwritten)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size()}[whence]
        self._position = start + offset
        return self._position

    def tell(self) -> int:
        return self._position

    def write(self, data: Any) -> int:
        content = memoryview(data).cast("B")
        written = 0
        try:
            while written < len(content) and self.error is None:
                written += os.pwrite(self._descriptor, content[written:], self._position + written)
        except OSError as error:
            self.error = error
        if written < len(content):
            self._unwritten.append((self._position + written, bytes(content[written:])))
        self._position += len(content)
        return len(content)

    def read(self, count: int) -> bytes:
        content = bytearray(count)
        self.readinto(content)
        return bytes(content)

    def readinto(self, buffer: Any) -> int:
        target = memoryview(buffer).cast("B")
        first, count = self._position, len(target)
        content = os.pread(self._descriptor, count, first)
        target[: len(content)] = content
        target[len(content) :] = bytes(count - len(content))
        for offset, part in self._unwritten:
            low, high = max(first, offset), min(first + count, offset + len(part))
            if low < high:
                target[low - first : high - first] = part[low - offset : high - offset]
        self._position += count
        return count

    def truncate(self, size: int | None = None) -> int:
        size = self._position if size is None else size
        try:
            if self.error is None:
                os.ftruncate(self._descriptor, size)
        except OSError as error:
            self.error = error
        return size

    def flush(self) -> None:
        """Does nothing: writes are not buffered."""

    def _size(self) -> int:
        ends = [offset + len(part) for offset, part in self._unwritten]
        return max(os.fstat(self._descriptor).st_size, *ends, 0)
