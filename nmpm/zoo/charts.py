"""The chart of an entry: its error over the frames of a rollout, and over its training."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import read_yaml
from nmpm.evaluation.figures import PREDICTORS

CHART = "chart.png"


def write_chart(folder: Path) -> None:
    """Write `chart.png` of an entry's `errors.csv` and of the `curve` of its card; nothing where both are missing."""
    figure = draw_chart(folder, read_yaml(folder / "card.yaml"))
    if figure is not None:
        save_chart(folder, figure)


def draw_chart(folder: Path, card: Mapping[str, Any]) -> Figure | None:
    """The chart of an entry with this card; None where it has neither `errors.csv` nor a curve."""
    errors, curve = _read_errors(folder / "errors.csv"), card.get("curve") or []
    if not errors and not curve:
        return None
    figure = Figure(figsize=(4.6 * (bool(errors) + bool(curve)), 3.0), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = iter(figure.subplots(1, bool(errors) + bool(curve), squeeze=False)[0])
    if errors:
        _draw_errors(next(axes), errors, card)
    if curve:
        _draw_training(next(axes), curve)
    return figure


def save_chart(folder: Path, figure: Figure) -> None:
    """Write a chart to an entry's folder."""
    with atomic_write(folder / CHART) as part:
        figure.savefig(part, format="png")


def _draw_errors(axes: Axes, errors: Mapping[str, Sequence[float]], card: Mapping[str, Any]) -> None:
    frames = errors["frame"]
    for kind, label in PREDICTORS.items():
        axes.plot(frames, [1e3 * value for value in errors[kind]], label=label)
    # Free fall is exact at first, by ten orders of magnitude more than what the curves are about.
    lowest = min((1e3 * value for value in errors["model"] if value > 0), default=None)
    axes.set(xlabel="frame", ylabel="squared error ×10⁻³", yscale="log", title=f"{card['name']}: test scenes")
    axes.set_ylim(bottom=lowest and lowest / 2)
    axes.legend(frameon=False, fontsize="small")


def _draw_training(axes: Axes, curve: Sequence[Sequence[float]]) -> None:
    values = [1e3 * point[2] for point in curve]
    axes.plot([point[0] / 3600 for point in curve], values, marker=".")
    scale = "log" if max(values) > 10 * min(values) else "linear"
    axes.set(xlabel="hours of training", ylabel="validation MSE ×10⁻³", yscale=scale, title="full rollouts")


def _read_errors(path: Path) -> dict[str, list[float]]:
    """The columns of a run's `errors.csv`; empty where there is none."""
    if not path.is_file():
        return {}
    with path.open(encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name]) for row in rows] for name in rows[0]} if rows else {}
