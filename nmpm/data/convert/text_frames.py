"""Text files of numbers, plain or gzipped, read in blocks of lines; formats whose frames follow each other."""

from __future__ import annotations

import abc
import codecs
import csv
import gzip
import io
import re
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.bounded_files import EXPANSION, check_regular, expansion_limit, is_gzip
from nmpm._support.messages import one_line
from nmpm.data.convert.base import readable
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.frames import Frame
from nmpm.errors import DataError

_LINE_BYTES = 2**20
_BUFFER_BYTES = 2**16
_BLOCK_LINES, _ROW_BYTES = 2**11, 2**15  # lines of particles
_TEXT_MEMORY, _TEXT_MEMORY_PER_CHARACTER = 2**20, 16
_PARTICLE_BYTES = 4  # "0 0" and its end


class Lines:
    """The lines of a file in order.

    Args:
        file: An open binary file.
        limit: Bytes that it may have in all.
    """

    def __init__(self, file: Any, limit: int) -> None:
        self._file, self._left = file, limit
        self.number = 0
        """Of lines that were read."""

    def next(self) -> str:
        """The next line without its end; empty at the end of the file, and " " for an empty line.

        Raises:
            ValueError: if it is very long.
        """
        line = self._rest_of_line()
        self._count(1, len(line))
        return line.decode("utf-8", "replace").rstrip() or (" " if line else "")

    def texts(self, size: int) -> list[str]:
        """The next lines without their ends, of about so many bytes; none at the end of the file.

        Raises:
            ValueError: if one is very long.
        """
        data: bytes = self._file.read(size)
        data += self._rest_of_line() if data and not data.endswith(b"\n") else b""
        lines = data.decode("utf-8", "replace").replace("\r", "").removesuffix("\n").split("\n") if data else []
        self._count(len(lines), len(data))
        return lines

    def block(self, count: int, start: int) -> bytes:
        """The next lines, which belong to a frame that began after `start` lines.

        Raises:
            ValueError: if there are fewer, one is empty, or the last one is cut short.
        """
        left, parts = count, list[bytes]()
        rows = iter(partial(self._file.readline, _ROW_BYTES), b"")
        while left and (lines := list(islice(rows, min(left, _BLOCK_LINES)))):
            sizes = list(map(len, lines))
            self._count(len(lines), sum(sizes))
            if max(sizes) == _ROW_BYTES:
                raise ValueError(f"line {self.number} or before: it has more than {_ROW_BYTES:,} characters")
            if min(sizes) < _PARTICLE_BYTES and lines[-1].endswith(b"\n"):
                raise ValueError(f"line {self.number} or before: an empty line among those of particles")
            parts.append(b"".join(lines))  # lines of their own take ten times their bytes
            left -= len(lines)
        if left or (parts and not parts[-1].endswith(b"\n")):
            raise ValueError(f"it ends at line {self.number}, within a frame{complete_frames(start)}")
        return b"".join(parts)

    @property
    def stored(self) -> int:
        """Bytes of the file that were read, as they are stored."""
        return int(getattr(self._file.raw, "fileobj", self._file).tell())

    def _rest_of_line(self) -> bytes:
        line: bytes = self._file.readline(_LINE_BYTES)
        if len(line) == _LINE_BYTES:
            raise ValueError(f"line {self.number + 1} has more than {_LINE_BYTES:,} characters")
        return line

    def _count(self, lines: int, size: int) -> None:
        self.number += lines
        self._left -= size
        if self._left < 0:
            raise ValueError(f"it unpacks to more than {EXPANSION} times its size")


def complete_frames(lines: int) -> str:
    """Advice, for an error, on a file that ends within a frame which begins after so many lines."""
    return f"; its first {lines} lines are complete frames: head -n {lines}" if lines else ""


@contextmanager
def open_lines(path: Path, kind: str) -> Iterator[Lines]:
    """Opens a text file, gzipped or not.

    Raises:
        DataError: naming the file, for its errors and any ValueError within; `kind` is what it should be.
    """
    check_regular(path)
    packed, size = is_gzip(path), path.stat().st_size
    limit = expansion_limit(size) if packed else 2 * size + 1
    with (
        readable(path, kind, zlib.error, csv.Error),
        # The buffer reads lines several times faster than GzipFile.
        io.BufferedReader(gzip.GzipFile(path), _BUFFER_BYTES) if packed else path.open("rb") as file,
    ):
        yield Lines(_as_utf8(file, limit), limit)


def _as_utf8(file: io.BufferedReader[Any], limit: int) -> io.BufferedReader[Any]:
    """A text file in UTF-8 without its mark; one in UTF-16, as Excel writes it, is read whole, up to a limit."""
    start = file.peek(4)[:4]
    if start.startswith(codecs.BOM_UTF8):
        file.read(len(codecs.BOM_UTF8))
    little = start.startswith(codecs.BOM_UTF16_LE) or start[1::2] == b"\0\0"
    if not little and not start.startswith(codecs.BOM_UTF16_BE) and start[::2] != b"\0\0":
        return file
    text = file.read(limit).decode("utf-16-le" if little else "utf-16-be", "replace")
    return io.BufferedReader(io.BytesIO(text.removeprefix("\ufeff").encode()))


def parse_columns(block: bytes, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The columns of lines by name: numbers (float64), or texts where the first line has one.

    Raises:
        ValueError: if a line has fewer columns, or a text among numbers.
    """
    first = block.partition(b"\n")[0].split()
    if block and len(first) != len(names):
        raise ValueError(f"{len(first)} columns, but {len(names)} names: {one_line(' '.join(names))}")
    texts = [index for index, word in enumerate(first) if not is_number(word)]
    numbers = [index for index in range(len(names)) if index not in texts]
    if not block:
        return {name: np.zeros(0) for name in names}
    if any(re.fullmatch(rb"[-+]?\d*,\d+([eE][-+]?\d+)?", first[index]) for index in texts):
        raise ValueError("its numbers have decimal commas; write points")
    values = np.loadtxt(io.BytesIO(block), comments=None, usecols=numbers, ndmin=2)
    if len(values) != block.count(b"\n"):
        raise ValueError("an empty line among those of particles")
    columns = {names[index]: values[:, column] for column, index in enumerate(numbers)}
    for index in texts:
        words = [line.split(None, index + 1)[index : index + 1] for line in io.BytesIO(block)]
        if not all(words):
            raise ValueError(f"a line has no column {names[index]}")
        columns[names[index]] = text_array([word.decode("ascii") for (word,) in words])
    return columns


def text_array(words: Sequence[str]) -> np.ndarray:
    """An array of texts; raises ValueError for a long one among short ones, which would all take as much memory."""
    longest = max(map(len, words), default=0)
    if longest * len(words) > _TEXT_MEMORY + _TEXT_MEMORY_PER_CHARACTER * sum(map(len, words)):
        raise ValueError(f"it has a word of {longest:,} characters")
    return np.array(words, dtype=str)


def is_number(word: Any) -> bool:
    """Whether a word, or another value of a table, is a number."""
    try:
        float(word)
    except (TypeError, ValueError):
        return False
    return True


class TextFrames(FrameFormat):
    """Abstract reader of text files whose frames are a header and a line per particle, one subclass per format.

    Attributes:
        kind: What a file should be, for messages.
    """

    kind: ClassVar[str]

    @abc.abstractmethod
    def blocks(self, lines: Lines) -> Iterator[tuple[str, Any, bytes]]:
        """Yields the name of each frame, for messages, its header and the lines of its particles."""

    @abc.abstractmethod
    def frame(self, header: Any, block: bytes) -> Frame:
        """The frame of a header and its lines; raises a ValueError that says what is wrong with it."""

    def frames(self, file: Path) -> Iterator[Frame]:
        with open_lines(file, self.kind) as lines:
            for name, header, block in self.blocks(lines):
                try:
                    frame = self.frame(header, block)
                except ValueError as error:
                    raise DataError(f"{file}, {name}: {one_line(error).removesuffix('.')}.") from error
                yield frame

    def count(self, file: Path) -> int:
        with open_lines(file, self.kind) as lines:
            return sum(1 for _ in self.blocks(lines))
