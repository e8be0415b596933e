"""Which formats pictures can be written in."""

from __future__ import annotations

from collections.abc import Iterable
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
