"""Progress of long work, on standard error: a bar on terminals and in notebooks, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import timedelta
from importlib.util import find_spec
from typing import Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

LINE_SECONDS = 30.0
"""Least time between two lines, where standard error is a file or a pipe."""
_ACTIVE: ContextVar[Progress | None] = ContextVar("_ACTIVE", default=None)
"""The bar that is shown now; a bar within it is another line of it."""


class Advance(Protocol):
    """Counts finished steps; `what` is done now, if that has changed."""

    def __call__(self, what: str = "", by: int = 1) -> object: ...


@contextmanager
def progress_bar(what: str, total: int | None, done: int = 0) -> Iterator[Advance]:
    """Shows how much is done and the time left; on terminals it vanishes at the end.

    `what` describes the work of `total` steps, None where that is unknown, of which some are `done` already. Yields a
    function to call after each step.
    """
    outer = _ACTIVE.get()
    if outer is not None:
        inner = outer.add_task(what, total=total, completed=done)
        try:
            yield lambda what="", by=1: _advance(outer, inner, what, by)
        finally:
            outer.remove_task(inner)
        return
    console = Console(stderr=True)
    # Without ipywidgets rich would warn at every bar of a notebook.
    if not (console.is_terminal or (console.is_jupyter and find_spec("ipywidgets"))):
        lines = _Lines(console, what, total, done)
        yield lines.step
        lines.end()
        return
    times = (TimeElapsedColumn(), TextColumn("ETA"), TimeRemainingColumn())
    columns = (BarColumn(bar_width=20), MofNCompleteColumn(), *times, TextColumn("{task.description}"))
    # Drawn once a second, as times are measured beside it.
    with Progress(*columns, console=console, transient=True, refresh_per_second=1) as progress:
        task, token = progress.add_task(what, total=total, completed=done), _ACTIVE.set(progress)
        try:
            yield lambda what="", by=1: _advance(progress, task, what, by)
        finally:
            _ACTIVE.reset(token)


def _advance(progress: Progress, task: TaskID, what: str, by: int) -> None:
    progress.update(task, advance=by, description=what or None)


class _Lines:
    """Progress as lines of text, none of them within the first `LINE_SECONDS`."""

    def __init__(self, console: Console, what: str, total: int | None, done: int) -> None:
        self._console, self._what, self._total, self._done = console, what, total, done
        self._first, self._start = done, time.monotonic()
        self._printed = self._start

    def step(self, what: str = "", by: int = 1) -> None:
        self._what, self._done, now = what or self._what, self._done + by, time.monotonic()
        if by and self._done != self._total and now - self._printed >= LINE_SECONDS:
            self._printed = now
            self._print(self._remaining(now - self._start))

    def end(self) -> None:
        """Say how long all took, if that was long."""
        seconds = time.monotonic() - self._start
        if seconds >= LINE_SECONDS:
            self._print(f", {timedelta(seconds=round(seconds))} in all")

    def _remaining(self, seconds: float) -> str:
        if self._total is None:
            return ""
        left = seconds / (self._done - self._first) * (self._total - self._done)
        return f" ({self._done / self._total:.0%}), {timedelta(seconds=round(left))} left"

    def _print(self, rest: str) -> None:
        of = "" if self._total is None else f" of {self._total}"
        self._console.print(f"{self._what}: {self._done}{of}{rest}", markup=False, highlight=False, soft_wrap=True)
