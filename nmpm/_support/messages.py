"""Text for messages and tables."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches


def one_line(text: object, limit: int = 200) -> str:
    """The text without line breaks, cut to `limit` characters."""
    joined = " ".join(str(text).split())
    return joined if len(joined) <= limit else f"{joined[: limit - 1]}…"


def counted(count: int, noun: str) -> str:
    """The number with the noun, such as "1 thread" or "2 threads"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def install(extra: str) -> str:
    """The command that installs an optional dependency, such as `pip install -e ".[play]"`."""
    return f'pip install -e ".[{extra}]" in the clone of nmpm'


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
