"""Reads HDF5 files from anywhere, and writes HDF5 files fast and to disks that may be full.

An HDF5 file can refer to other files (external links, external storage, virtual datasets), so that the bytes of any
file would be read as positions; `check_self_contained` refuses these, but not virtual datasets of the file's own
content. HDF5 crashes the process when a write fails, so `writable_hdf5` gives it a file whose writes never fail, and
reports the error afterwards. HDF5 compresses one chunk after the other, so `write_compressed` compresses in threads
what HDF5's own filters would store.
"""

from __future__ import annotations

import math
import os
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import check_regular, expansion_limit
from nmpm._support.messages import one_line
from nmpm._support.threads import map_ranges, split, usable_cores
from nmpm.errors import DataError, NmpmError

_ERRORS = (OSError, RuntimeError, LookupError, TypeError, ValueError, ArithmeticError, AttributeError, MemoryError)
"""What h5py raises on damaged files."""
_LOCK_SIGNS = ("unable to lock file", "file locking")
"""In HDF5's messages on files that another program, or another part of this one, has locked."""
_LEVEL = 1
FILTERS: Mapping[str, Any] = MappingProxyType({"shuffle": True, "compression": "gzip", "compression_opts": _LEVEL})
"""Options of h5py for a compressed dataset."""
_ZLIB_HEADER = b"\x78\x01"
_SAMPLE, _NOISE = 2**14, 0.95
"""First bytes that are compressed to try, and the share of their size from which on they are taken for noise."""
_AHEAD = 4
"""Compressed chunks per thread that are in memory before they are written."""


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
        reason = one_line(error)
        if any(sign in reason for sign in _LOCK_SIGNS):
            cause = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else reason
            mend = (
                f"is locked ({cause}). Close the program that has it open, e.g. a notebook that writes it; if there is"
                " none, as on some network or read-only disks, set HDF5_USE_FILE_LOCKING=FALSE."
            )
        elif isinstance(error, PermissionError):
            mend = "cannot be read (permission denied). Correct its permissions."
        else:
            mend = f"cannot be read as HDF5 ({reason}). Is it complete? Copy, download or generate it again."
        raise DataError(f"{path}: {mend}") from error


def check_self_contained(file: Any, path: Path) -> None:
    """Raises a DataError that names the link or dataset by which an open HDF5 file takes content from other files.

    Also for a dataset that a filter compressed that is not installed.
    """
    # By hand: h5py's `visititems` recurses in C, and crashes the process in deep groups.
    pending, visited = [file], {file}
    while pending:
        group = pending.pop()
        for name in group:
            where = f"{group.name}/{name}".lstrip("/")[:100]
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                raise _elsewhere_error(path, f"{where!r} is an external link to {link.filename!r}")
            # A soft link leads to an object that is visited by its other name, or nowhere.
            item = group[name] if isinstance(link, h5py.HardLink) else None
            if isinstance(item, h5py.Group) and item not in visited:
                visited.add(item)
                pending.append(item)
            elif isinstance(item, h5py.Dataset):
                _check_filters(item, f"{path}: {where}")
                if item.external:
                    raise _elsewhere_error(path, f"{where!r} is stored in another file, {item.external[0][0]!r}")
                for source in item.virtual_sources() if item.is_virtual else ():
                    origin = file.get(source.dset_name) if source.file_name == "." else None
                    if not isinstance(origin, h5py.Dataset) or origin.is_virtual:
                        raise _elsewhere_error(path, f"{where!r} is a virtual dataset")


def _check_filters(dataset: Any, where: str) -> None:
    """Loads the filters that compressed a dataset; raises a DataError for one that is not installed."""
    properties = dataset.id.get_create_plist()
    for number in range(properties.get_nfilters()):
        code, _, _, name = properties.get_filter(number)
        if not h5py.h5z.filter_avail(code):
            with suppress(ImportError):
                import hdf5plugin  # noqa: F401 (registers its filters)
        if not h5py.h5z.filter_avail(code):
            called = f" ({one_line(name.decode('utf-8', 'replace'), 40)})" if name else ""
            raise DataError(
                f"{where} is compressed by the HDF5 filter {code}{called}, which is not installed: pip install"
                " hdf5plugin has blosc, lz4, zstd and others. Or write it anew: h5repack -f GZIP=1 OLD NEW."
            )


def _elsewhere_error(path: Path, problem: str) -> DataError:
    return DataError(f"{path}: {problem}; content of other files is not read. Copy it into this file.")


def check_stored_size(dataset: Any, where: str) -> None:
    """Refuses, with a DataError, a dataset that declares far more than its file stores, before memory is taken."""
    declared, chunk = (math.prod(shape) * dataset.dtype.itemsize for shape in (dataset.shape, dataset.chunks or (0,)))
    sources = {source.dset_name for source in dataset.virtual_sources()} if dataset.is_virtual else {dataset.name}
    stored = sum(int(dataset.file[name].id.get_storage_size()) for name in sources)
    if max(declared, chunk) > expansion_limit(stored):
        raise DataError(
            f"{where}: has the shape {dataset.shape}, {max(declared, chunk):,} bytes, but only {stored:,} bytes are"
            " stored. Is the file complete? Copy, download or generate it again."
        )


def write_compressed(group: Any, name: str, values: np.ndarray, rows: int, threads: int | None = None) -> None:
    """Adds a compressed dataset to an HDF5 group, in chunks of so many rows; by default a thread per core."""
    chunk = (rows, *values.shape[1:])
    dataset = group.create_dataset(name, shape=values.shape, dtype=values.dtype, chunks=chunk, **FILTERS)
    threads = threads or usable_cores()
    ranges, rest = split(len(values), rows), (0,) * (values.ndim - 1)
    for first in range(0, len(ranges), _AHEAD * threads):
        batch = ranges[first : first + _AHEAD * threads]
        packed = map_ranges(lambda low, high: _compress(values[low:high], rows), batch, threads)
        for (low, _), content in zip(batch, packed, strict=True):
            dataset.id.write_direct_chunk((low, *rest), content)


def _compress(values: np.ndarray, rows: int) -> bytes:
    """A chunk as HDF5 stores it: filled with zeros to all its rows, first bytes of all values first, compressed."""
    if len(values) < rows:
        values = np.concatenate([values, np.zeros((rows - len(values), *values.shape[1:]), values.dtype)])
    octets = np.ascontiguousarray(values).reshape(-1).view(np.uint8).reshape(-1, values.itemsize)
    planes = [plane.tobytes() for plane in octets.T]
    end = _deflate_stream(_LEVEL).flush()
    checksum = zlib.adler32(b"".join(planes)).to_bytes(4, "big")
    return b"".join((_ZLIB_HEADER, *map(_deflate, planes), end, checksum))


def _deflate_stream(level: int) -> zlib._Compress:
    return zlib.compressobj(level, wbits=-zlib.MAX_WBITS)


def _deflate(plane: bytes) -> bytes:
    """Blocks of a deflate stream, which others may follow; bytes that look like noise, as low ones of floats, as are.

    These take most of the time of compressing all, and make nothing smaller. Zeros at the end are compressed.
    """
    filled = plane.rstrip(b"\0")
    sample = filled[:_SAMPLE]
    level = 0 if len(zlib.compress(sample, _LEVEL)) > _NOISE * len(sample) else _LEVEL
    blocks = b""
    for part, stream in ((filled, _deflate_stream(level)), (plane[len(filled) :], _deflate_stream(_LEVEL))):
        blocks += stream.compress(part) + stream.flush(zlib.Z_FULL_FLUSH)
    return blocks


@contextmanager
def writable_hdf5(path: Path, **options: Any) -> Iterator[tuple[Any, Callable[[], None]]]:
    """Opens a new HDF5 file, with options of `h5py.File`, which replaces `path` once it is complete.

    Yields:
        The open HDF5 file, and a function that raises the error of an earlier write; call it after each large write.

    Raises:
        DataError: if a write fails, e.g. because the disk is full; `path` is then as it was.
    """
    with ExitStack() as stack:
        try:
            part = stack.enter_context(atomic_write(path))
            target = _NeverFailingFile(stack.enter_context(part.open("w+b", buffering=0)).fileno())
        except OSError as error:
            raise DataError(
                f"{path}: cannot be written ({error.strerror}). Correct the permissions, or choose another folder."
            ) from error

        def check() -> None:
            if target.error is not None:
                folder = next(folder for folder in path.absolute().parents if folder.is_dir())
                more = sum(len(content) for _, content in target.unwritten)
                raise DataError(
                    f"{path}: cannot be written ({target.error.strerror}): at least {more} more bytes are needed,"
                    f" {shutil.disk_usage(folder).free} are free on its disk. Free space or choose another folder."
                ) from target.error

        with h5py.File(target, "w", **options) as file:
            yield file, check
        check()


class _NeverFailingFile:
    """The file object that h5py writes to; content that cannot be written is kept in memory, and the error noted.

    Reads return that content too, so that HDF5 can close the file in order. The caller stops after the first error, so
    that no more than one trajectory and HDF5's caches are kept.
    """

    def __init__(self, descriptor: int) -> None:
        self.error: OSError | None = None
        self._descriptor, self._position = descriptor, 0
        self.unwritten: list[tuple[int, bytes]] = []

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        ends = (os.fstat(self._descriptor).st_size, *(first + len(part) for first, part in self.unwritten))
        self._position = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: max(ends)}[whence]
        return self._position

    def tell(self) -> int:
        return self._position

    def write(self, data: Any) -> int:
        content, written = memoryview(data).cast("B"), 0
        try:
            while written < len(content) and self.error is None:
                written += os.pwrite(self._descriptor, content[written:], self._position + written)
        except OSError as error:
            self.error = error
        if written < len(content):
            self.unwritten.append((self._position + written, bytes(content[written:])))
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
        target[:] = content + bytes(count - len(content))
        for offset, part in self.unwritten:
            low, high = max(first, offset), min(first + count, offset + len(part))
            if low < high:
                target[low - first : high - first] = part[low - offset : high - offset]
        self._position += count
        return count

    def truncate(self, size: int) -> int:
        try:
            if self.error is None:
                os.ftruncate(self._descriptor, size)
        except OSError as error:
            self.error = error
        return size

    def flush(self) -> None:
        """Does nothing: writes are not buffered."""
