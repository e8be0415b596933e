"""Where pictures go: known formats, whole files."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from nmpm.errors import ConfigError


def check_suffix(path: Path, supported: Iterable[str], purpose: str) -> str:
    """The suffix of a file to write, in lower case.

    Raises:
        ConfigError: if it is none of those supported.
    """
    suffix = path.suffix.lower()
    if suffix not in supported:
        raise ConfigError(f"Cannot write {purpose} to {path}: its name must end in {' or '.join(supported)}.")
    return suffix


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Gives a temporary path of the same suffix beside `path`, and renames it to `path` once all went well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
