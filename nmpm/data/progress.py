"""Progress bars with an estimate of the remaining time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress

from nmpm._support.progress import lacks_widgets, progress_columns


@contextmanager
def progress_bar(what: str, total: int | None, done: int = 0) -> Iterator[Callable[[], None]]:
    """Shows a progress bar on standard error; yields the function that advances it by one.

    Args:
        what: Description of the work.
        total: Number of steps; None where it is unknown.
        done: Steps that are done already.
    """
    console = Console(stderr=True)
    with Progress(*progress_columns(), console=console, disable=lacks_widgets(console)) as progress:
        task = progress.add_task(what, total=total, completed=done)
        yield lambda: progress.advance(task)
