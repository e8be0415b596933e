"""The battery's report: a table, JSON, Markdown and a picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table

from nmpm._support.atomic import atomic_write
from nmpm.evaluation.stress.lines import Line

VERDICTS = {True: "pass", False: "FAIL", None: "–"}


def row(line: Line) -> tuple[str, str, str]:
    """Verdict, what was tested, and what was measured, in words."""
    figures = ", ".join(f"{name.replace('_', ' ')} {value:.3g}" for name, value in line.figures.items())
    return VERDICTS[line.passed], line.name, figures


def table(title: str, lines: Sequence[Line]) -> Table:
    """All lines, a section for each group."""
    drawn = Table(title=title, title_justify="left")
    for heading in ("", "test", "measured"):
        drawn.add_column(heading, overflow="fold")
    group = ""
    for line in lines:
        if line.group != group:
            group = line.group
            drawn.add_section()
            drawn.add_row("", f"[bold]{group}[/bold]", "")
        verdict, name, figures = row(line)
        colour = {True: "green", False: "red", None: "dim"}[line.passed]
        drawn.add_row(f"[{colour}]{verdict}[/{colour}]", name, figures)
    return drawn


def summary(lines: Sequence[Line]) -> str:
    """How many lines passed and failed, in one sentence."""
    passed = sum(line.passed is True for line in lines)
    failed = [line.name for line in lines if line.passed is False]
    return f"{passed} passed, {len(failed)} failed" + (f": {'; '.join(failed)}." if failed else ".")


def as_json(subject: str, size: str, seconds: float, lines: Sequence[Line]) -> str:
    """The whole report as JSON."""
    plain: dict[str, Any] = {
        "model": subject,
        "size": size,
        "seconds": round(seconds, 1),
        "lines": [asdict(line) for line in lines],
    }
    return json.dumps(plain, indent=1)


def write(folder: Path, text: str, lines: Sequence[Line], stem: str = "stress") -> list[Path]:
    """Write `<stem>.json`, `<stem>.md` and `<stem>.png` into a folder, which is made if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{stem}.{suffix}" for suffix in ("json", "md", "png")]
    with atomic_write(paths[0]) as part:
        part.write_text(text + "\n", encoding="utf-8")
    with atomic_write(paths[1]) as part:
        part.write_text(_markdown(lines), encoding="utf-8")
    _draw(paths[2], lines)
    return paths


def _markdown(lines: Sequence[Line]) -> str:
    head = ["| | test | measured | needed |", "|---|---|---|---|"]
    body = [f"| {' | '.join(row(line))} | {line.needs} |" for line in lines]
    return "\n".join(head + body) + "\n"


def _draw(path: Path, lines: Sequence[Line]) -> None:
    """The curves, one panel each."""
    from matplotlib.figure import Figure

    curves = [(line.name, name, *curve) for line in lines for name, curve in line.curves.items()]
    figure = Figure(figsize=(9, 2.6 * max(1, len(curves))), layout="constrained")
    panels = figure.subplots(max(1, len(curves)), 1, squeeze=False)[:, 0]
    for panel, (title, name, values, frames) in zip(panels, curves, strict=False):
        panel.plot([frames * (index + 1) / len(values) for index in range(len(values))], values, lw=1.2)
        panel.axhline(0, color="0.7", lw=0.8)
        panel.set(title=title, ylabel=name, xlabel="frame")
    with atomic_write(path) as part:
        figure.savefig(part, dpi=110, format="png")
