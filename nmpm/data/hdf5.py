"""Reads HDF5 files from untrusted sources, and writes HDF5 files to disks that may be full.

An HDF5 file can refer to other files (external links, external storage, virtual datasets), so that the bytes of any
file would be read as positions; `check_self_contained` refuses these. HDF5 crashes the process when a write fails, so
`writable_hdf5` gives it a file whose writes never fail and reports the error afterwards.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from io import FileIO
from pathlib import Path
from typing import Any

import h5py

from nmpm._support.atomic import replacing
from nmpm.data.regular_files import check_regular
from nmpm.errors import DataError


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Opens an HDF5 file for reading.

    Raises:
        DataError: if it is not a regular file, or HDF5 cannot read it; names the file.
    """
    check_regular(path)
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DataError(
            f"{path}: cannot be read as HDF5 ({reason}). Is it complete? Copy, download or generate it again."
        ) from error


def check_self_contained(file: Any, path: Path) -> None:
    """Raises an error if an open HDF5 file takes content from other files.

    Raises:
        DataError: names the file and the link or dataset.
    """

    def link_elsewhere(name: str, link: Any) -> str | None:
        return f"{name!r} is an external link to {link.filename!r}" if isinstance(link, h5py.ExternalLink) else None

    def dataset_elsewhere(name: str, item: Any) -> str | None:
        if not isinstance(item, h5py.Dataset):
            return None
        if item.external:
            return f"{name!r} is stored in another file, {item.external[0][0]!r}"
        return f"{name!r} is a virtual dataset" if item.is_virtual else None

    # The callbacks return what they find, as h5py loses exceptions that they raise. Links come first: they are not
    # followed, and without external ones nothing opens another file.
    found = file.visititems_links(link_elsewhere) or file.visititems(dataset_elsewhere)
    if found is not None:
        raise DataError(f"{path}: {found}; content of other files is not read. Copy it into this file.")


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
    with _replacing(path) as raw:
        target = _NeverFailingFile(raw.fileno())

        def check() -> None:
            if target.error is not None:
                raise _write_error(path, target.error, target.unwritten_bytes) from target.error

        with h5py.File(target, "w", **options) as file:
            yield file, check
        check()


@contextmanager
def _replacing(path: Path) -> Iterator[FileIO]:
    """Opens a temporary file that replaces `path` on success."""
    with ExitStack() as stack:
        try:
            part = stack.enter_context(replacing(path))
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
