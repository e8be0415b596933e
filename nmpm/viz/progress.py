"""A progress bar for what takes long, and nothing for what does not."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress

PATIENCE = 2.0
"""Seconds without a bar."""

Item = TypeVar("Item")


def tracked(items: Iterable[Item], total: int, description: str) -> Iterator[Item]:
    """The items, with a bar on the terminal (standard error) if they take longer than two seconds."""
    console = Console(stderr=True)
    progress = Progress(console=console, transient=True)
    task = progress.add_task(description, total=total)
    began = time.monotonic()
    shown = False
    try:
        for done, item in enumerate(items, start=1):
            yield item
            progress.update(task, completed=done)
            if not shown and console.is_terminal and time.monotonic() - began > PATIENCE:
                progress.start()
                shown = True
    finally:
        if shown:
            progress.stop()
