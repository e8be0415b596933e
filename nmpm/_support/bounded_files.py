"""Files from anywhere: only regular files are opened, and what they hold is bounded before it is read or built."""

from __future__ import annotations

import gzip
import os
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from nmpm._support.messages import one_line
from nmpm.errors import DataError

FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
"""Names in files of others that become names of files: none is hidden or leads to another folder."""
TEXT_BYTES = 2**20
"""Size of a card, configuration or report."""
DEPTH = 32
"""Nesting of lists and mappings in YAML and JSON."""
YAML_VALUES = 100_000
"""Values in a YAML file; those that an alias repeats count again."""
PLAIN_VALUES = 10**6
"""Values in a JSON file or a pickle's metadata."""
INTEGER = 2**63
"""Integers in YAML and JSON are smaller."""
EXPANSION = 200
"""Bytes that a compressed file may unpack to, per stored byte; floats compress to a tenth at best."""

ZIP_ERRORS: tuple[type[Exception], ...] = (
    OSError,
    EOFError,
    RuntimeError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)
"""Raised by zipfile for damaged, encrypted or unknown archives."""
NPZ_ERRORS: tuple[type[Exception], ...] = (
    *ZIP_ERRORS,
    KeyError,
    ValueError,
    TypeError,
    ArithmeticError,
    MemoryError,
    SyntaxError,
    tokenize.TokenError,
)
"""Raised for damaged `.npz` files, by NumPy too."""

_CONTROL = re.compile(r"[^\n\r\t\x20-\x7e\xa0-\ud7ff\ue000-\U0010ffff]")


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # (its type is not known)
    """PyYAML's, which reads 1e-3 as a number too, as YAML 1.2 and OmegaConf do."""


class _Dumper(yaml.SafeDumper):
    """Quotes texts, such as digests, that `_Loader` would read as numbers."""


for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
    )


def expansion_limit(stored: int) -> int:
    """Bytes that `stored` bytes may unpack to; 256 MiB are always allowed."""
    return 2**28 + EXPANSION * stored


def check_regular(path: Path) -> None:
    """Raises an error unless a path is a file or a link to one: opening a pipe would wait, a device may never end.

    Raises:
        DataError: naming the path.
    """
    if not os.path.isfile(path):
        reason = "is not a regular file; give a file" if os.path.exists(path) else "No such file"
        raise DataError(f"{path} cannot be read: {reason}.")


def check_within(path: Path, other: Path) -> None:
    """Refuses, with a DataError, another file that a file names and that is not in its folder or a folder there."""
    if not other.resolve().is_relative_to(path.parent.resolve()):
        raise DataError(f"{path}: it names {one_line(other)}, which is not in its folder. Copy it there.")


def is_gzip(path: Path) -> bool:
    """Whether a file is gzipped, by its first bytes."""
    with path.open("rb") as file:
        return file.read(2) == b"\x1f\x8b"


def starts_with(path: Path, signature: bytes) -> bool:
    """Whether a file, gzipped or not, begins with some bytes; damaged files do not."""
    try:
        check_regular(path)
        with gzip.open(path) if is_gzip(path) else path.open("rb") as file:
            return file.read(len(signature)) == signature
    except (OSError, EOFError, zlib.error, DataError):
        return False


def read_bounded(path: Path, limit: int) -> bytes:
    """The content of a regular file of at most `limit` bytes.

    Raises:
        DataError: if there is no such file, or it cannot be read or is larger.
    """
    check_regular(path)
    try:
        size = os.path.getsize(path)
        if size > limit:
            raise DataError(f"{path} cannot be read: it has more than {limit:,} bytes.")
        with path.open("rb") as file:
            return file.read(size)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}.") from error


def read_text(path: Path) -> str:
    """The text of a regular file of at most `TEXT_BYTES`.

    Raises:
        DataError: as `read_bounded`, or if it is not UTF-8.
    """
    try:
        return read_bounded(path, TEXT_BYTES).decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} cannot be read: {error}") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping that a YAML file holds, of texts, numbers, truth values, lists and mappings.

    Raises:
        DataError: as `read_text`, or if it is too deep, not YAML, or holds anything else.
    """
    return parse_yaml(read_text(path), path)


def parse_yaml(text: str, where: Path | str) -> dict[str, Any]:
    """As `read_yaml`, of a text; one without content is an empty mapping. Errors name `where`."""
    try:
        check_yaml(text)
        plain = yaml.load(text, _Loader)  # noqa: S506 (a safe loader)
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise DataError(f"{where} cannot be read: {one_line(error)}") from error
    plain = {} if plain is None else plain
    if not isinstance(plain, dict):
        raise DataError(f"{where} should hold keys and values.")
    check_plain(plain, where)
    return plain


def to_yaml(content: Mapping[str, Any]) -> str:
    """The text that `parse_yaml` reads as this content, lists and mappings of plain values in a line each."""
    return yaml.dump(
        dict(content), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120, default_flow_style=None
    )


def check_yaml(text: str) -> None:
    """Refuses YAML that is nested too deep, or whose aliases repeat too much, before it is built.

    Raises:
        ValueError: naming the line.
        yaml.YAMLError: if it is not YAML.
    """
    values, sizes = 0, dict[str | None, int]()
    opened: list[tuple[str | None, int]] = []
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.AliasEvent):  # also refuses those within what they repeat
            values += sizes.get(event.anchor, YAML_VALUES + 1)
        elif isinstance(event, yaml.CollectionStartEvent):
            opened.append((event.anchor, values))
        elif isinstance(event, yaml.CollectionEndEvent | yaml.ScalarEvent):
            anchor, before = opened.pop() if isinstance(event, yaml.CollectionEndEvent) else (event.anchor, values)
            values += 1
            sizes[anchor] = values - before
        if len(opened) > DEPTH or values > YAML_VALUES:
            line = event.start_mark.line + 1 if event.start_mark else 0
            raise ValueError(f"line {line}: nested more than {DEPTH} deep, or aliases repeat too much.")


def check_plain(value: Any, where: Path | str) -> None:
    """Refuses all but texts, numbers, truth values, None, lists, and mappings with texts as keys.

    Raises:
        DataError: naming `where` and the value; also for control characters, and where it is nested too deep.
    """
    pending, count = [(value, 0)], 0
    while pending:
        item, depth = pending.pop()
        count += 1
        if depth > DEPTH or count > PLAIN_VALUES:
            raise DataError(f"{where} cannot be read: its lists and mappings are nested more than {DEPTH} deep.")
        if isinstance(item, Mapping):
            wrong = next((key for key in item if not isinstance(key, str)), None)
            if wrong is not None:
                raise DataError(f"{where} cannot be read: the key {one_line(wrong, 60)} is not a string; quote it.")
            pending += [(inner, depth + 1) for inner in (*item.keys(), *item.values())]
        elif isinstance(item, list | tuple):
            pending += [(inner, depth + 1) for inner in item]
        elif isinstance(item, str) and _CONTROL.search(item):
            raise DataError(f"{where}: {one_line(repr(item), 60)} has a control character.")
        elif isinstance(item, int) and abs(item) >= INTEGER:
            raise DataError(f"{where} cannot be read: it holds an integer of more than 63 bits.")
        elif item is not None and not isinstance(item, str | int | float):
            raise DataError(
                f"{where} cannot be read: it holds the {type(item).__name__} {one_line(item, 60)}; quote it."
            )
