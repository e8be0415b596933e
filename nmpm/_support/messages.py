"""Text for messages and tables."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from importlib.util import find_spec
from typing import Any, TextIO

from nmpm.errors import ConfigError


def one_line(text: object, limit: int = 200) -> str:
    """The text without line breaks, cut to `limit` characters."""
    joined = " ".join(str(text).split())
    return joined if len(joined) <= limit else f"{joined[: limit - 1]}…"


def counted(count: int, noun: str) -> str:
    """The number with the noun, such as "1 thread" or "2 threads"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def span(interval: Sequence[float]) -> str:
    """The ends of an interval, such as "0.1…0.9"."""
    low, high = interval
    return f"{low:.4g}…{high:.4g}"


def install(extra: str) -> str:
    """The command that installs an optional dependency, such as `pip install -e ".[play]"`."""
    return f'pip install -e ".[{extra}]" in the clone of nmpm'


def require(module: str, extra: str, purpose: str) -> None:
    """Raise ConfigError, naming the purpose and the extra, if an optional dependency is not installed."""
    if find_spec(module) is None:
        raise ConfigError(f"{purpose} needs {module}, which is not installed: {install(extra)}.")


def suggestion(name: str, known: Iterable[str]) -> str:
    """The sentence "Did you mean …?" after a space, with the nearest known names; empty if none is near."""
    near = get_close_matches(name, list(known), n=3)
    return f" Did you mean {' or '.join(near)}?" if near else ""


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Show warnings as a line each, without the file and the line of code that they come from.

    Lightning replaces how warnings are shown when it is imported: what runs it enters this once more.
    """
    before = warnings.formatwarning
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    try:
        yield
    finally:
        warnings.formatwarning = before


class _UnfailingStream:
    """A text stream whose writes never raise: after the first that fails, as of a closed pipe, it writes nowhere."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = _nowhere() if stream is None else stream  # (None: closed before the process started)
        if hasattr(self._stream, "reconfigure"):
            self._stream.reconfigure(errors="replace")  # letters that the terminal's encoding lacks

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except (OSError, ValueError):
            self._stream = _nowhere()
            return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except (OSError, ValueError):
            self._stream = _nowhere()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _nowhere() -> TextIO:
    return open(os.devnull, "w", encoding="utf-8")


@contextmanager
def unfailing_output() -> Iterator[None]:
    """Let nothing that is printed end the work: not a closed pipe, a full disk, or an encoding without the letters."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (_UnfailingStream(stream) for stream in before)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = before
