"""A progress bar that appears only if the work takes long."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress

from nmpm._support.progress import progress_columns

DELAY = 2.0
"""Seconds before the bar appears."""

Item = TypeVar("Item")


def with_progress_bar(items: Iterable[Item], total: int, description: str) -> Iterator[Item]:
    """Yields the items, with a progress bar on the terminal (standard error) after `DELAY` seconds."""
    console = Console(stderr=True)
    progress = Progress(*progress_columns(), console=console, transient=True)
    task = progress.add_task(description, total=total)
    start = time.monotonic()
    visible = False
    try:
        for done, item in enumerate(items, start=1):
            yield item
            progress.update(task, completed=done)
            if not visible and console.is_terminal and time.monotonic() - start > DELAY:
                progress.start()
                visible = True
    finally:
        if visible:
            progress.stop()
