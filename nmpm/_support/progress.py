"""What every progress bar on the console shows."""

from __future__ import annotations

from importlib.util import find_spec

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


def progress_columns() -> tuple[ProgressColumn, ...]:
    """What is done, a bar, steps of all, time taken, and the estimate of what remains."""
    return (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
    )


def terminal_progress(console: Console) -> Progress:
    """Progress that vanishes from the terminal when it ends; nothing at all where the console is a file or a pipe."""
    # Drawn once a second, as times are measured beside it.
    return Progress(
        *progress_columns(), console=console, transient=True, disable=not console.is_terminal, refresh_per_second=1
    )


def lacks_widgets(console: Console) -> bool:
    """Whether a notebook cannot show progress, as ipywidgets is not installed; rich would warn at every bar."""
    return console.is_jupyter and find_spec("ipywidgets") is None
