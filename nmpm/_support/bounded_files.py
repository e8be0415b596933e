"""Small files from anywhere: only regular files are opened, none is read beyond a limit, YAML holds plain data only."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from nmpm._support.limits import ALIASED, DIGITS, TEXT_BYTES, TEXT_DEPTH
from nmpm._support.messages import one_line
from nmpm._support.regular_files import check_mode
from nmpm.errors import DataError


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # (its type is not known)
    """PyYAML's, which reads 1e-3 as a number too, as YAML 1.2 and OmegaConf do."""


class _Dumper(yaml.SafeDumper):
    """Quotes texts, such as digests, that `_Loader` would read as numbers."""


for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
    )
_LOADER = _Loader
_CONTROL = re.compile(r"[^\n\r\t\x20-\x7e\xa0-\ud7ff\ue000-\U0010ffff]")
_NUMBER = re.compile(r"[-+0-9_.:eE]+")


def read_bounded(path: Path, limit: int) -> bytes:
    """The content of a regular file of at most `limit` bytes; pipes and devices are not opened.

    Raises:
        DataError: if there is no such file, or it cannot be read, is not a regular file, or is larger.
    """
    try:
        # Before opening, as that would block on a named pipe.
        status = os.stat(path)
        check_mode(path, status.st_mode)
        if status.st_size > limit:
            raise DataError(f"{path} cannot be read: it has more than {limit:,} bytes.")
        with path.open("rb") as file:
            return file.read(status.st_size)
    except DataError:
        raise
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise DataError(f"{path} cannot be read: {reason}.") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping that a YAML file holds, of strings, numbers, truth values, lists and mappings.

    Raises:
        DataError: if the file cannot be read or is too large, too deep or not YAML, its aliases repeat too much, it
            has tags, or holds other values, such as dates, or control characters.
    """
    return parse_yaml(read_text(path), path)


def read_text(path: Path) -> str:
    """The text of a regular file of at most `TEXT_BYTES`.

    Raises:
        DataError: as `read_bounded`, or if it is not UTF-8.
    """
    try:
        return read_bounded(path, TEXT_BYTES).decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} cannot be read: {error}") from error


def parse_yaml(text: str, where: Path | str) -> dict[str, Any]:
    """As `read_yaml`, of a file's text; a text without content is an empty mapping.

    Args:
        text: In YAML.
        where: Its file, for messages.

    Raises:
        DataError: as `read_yaml`.
    """
    try:
        check_yaml(text)
        plain = yaml.load(text, _LOADER)  # noqa: S506 (a safe loader)
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise DataError(f"{where} cannot be read: {one_line(error)}") from error
    plain = {} if plain is None else plain
    if not isinstance(plain, dict):
        raise DataError(f"{where} should hold keys and values.")
    _check_plain(plain, where)
    return plain


def to_yaml(content: Mapping[str, Any]) -> str:
    """The text that `parse_yaml` reads as this content, lists and mappings of plain values in a line each."""
    return yaml.dump(
        dict(content), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120, default_flow_style=None
    )


@dataclass
class _Extent:
    """How large a node is, its aliases written out: values in it, and levels below it."""

    anchor: str | None
    values: int = 1
    depth: int = 0

    def add(self, inner: _Extent) -> None:
        self.values += inner.values
        self.depth = max(self.depth, inner.depth + 1)


def check_yaml(text: str) -> None:
    """Refuse what makes a short text a large or slow one, before anything is built.

    Raises:
        ValueError: naming it and its line.
        yaml.YAMLError: if it is not YAML.
    """
    anchors: dict[str, _Extent] = {}
    open_nodes, repeated = [_Extent("")], 0
    for event in yaml.parse(text, _LOADER):
        line = event.start_mark.line + 1 if event.start_mark else 0
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in anchors:
                raise ValueError(f"line {line}: *{one_line(event.anchor, 60)} stands for nothing before it.")
            open_nodes[-1].add(anchors[event.anchor])
            repeated += anchors[event.anchor].values
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append(_Extent(event.anchor))
        elif isinstance(event, yaml.CollectionEndEvent | yaml.ScalarEvent):
            ended = open_nodes.pop() if isinstance(event, yaml.CollectionEndEvent) else _Extent(event.anchor)
            open_nodes[-1].add(ended)
            if ended.anchor:
                anchors[ended.anchor] = ended
        if len(open_nodes) + open_nodes[-1].depth > TEXT_DEPTH + 2:
            raise ValueError(f"line {line} is nested more than {TEXT_DEPTH} deep.")
        if repeated > ALIASED:
            raise ValueError(f"line {line}: aliases stand for more than {ALIASED:,} values; write fewer.")
        tag = getattr(event, "tag", None)
        if tag is not None:
            raise ValueError(f"line {line} has the tag {one_line(tag, 60)}; only plain values are read.")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > DIGITS and _NUMBER.fullmatch(event.value):
            raise ValueError(f"line {line} has a number of more than {DIGITS} digits.")


def check_characters(value: object, path: Path | str) -> None:
    """Refuse control characters but line breaks and tabs, as they reach terminals, and halves of characters.

    Args:
        value: Text, or lists and mappings of it; other values are left out.
        path: Of the file that the text is of.

    Raises:
        DataError: naming the text.
    """
    if isinstance(value, Mapping):
        value = [*value.keys(), *value.values()]
    if isinstance(value, list | tuple):
        for item in value:
            check_characters(item, path)
    elif isinstance(value, str) and _CONTROL.search(value):
        raise DataError(f"{path}: {one_line(repr(value), 60)} has a control character.")


def _check_plain(value: Any, path: Path | str) -> None:
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str):
                raise DataError(f"{path} cannot be read: its key {one_line(repr(key), 60)} is not a string; quote it.")
            _check_plain(key, path)
            _check_plain(item, path)
    elif isinstance(value, list):
        for item in value:
            _check_plain(item, path)
    elif isinstance(value, str):
        check_characters(value, path)
    elif value is not None and not isinstance(value, int | float):
        raise DataError(f"{path} cannot be read: it holds the {type(value).__name__} {one_line(value, 60)}; quote it.")
