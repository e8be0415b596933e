"""The trade as a tidy CSV, and as a table for people."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence

import numpy as np
from rich.table import Table

from nmpm.evaluation.trade.choice import Kind
from nmpm.evaluation.trade.frontier import describe_measure, error_unit, standings
from nmpm.evaluation.trade.points import Point, measure_names
from nmpm.evaluation.trade.scenes import Scenes

SETTINGS = (
    "model", "weights", "precision", "constraints", "cells", "coarser", "substeps", "nudge", "runtime",
    "training_minutes",
)  # fmt: skip
"""Columns of what was chosen; empty where it does not apply."""

COLUMNS = (
    "dataset", "scenes", "particles", "kind", "name", *SETTINGS, "batch", "threads", "device", "hardware", "clock",
    "ms_per_frame", "ms_lower_quartile", "ms_upper_quartile", "ratio_to_reference", "ms_per_second",
    "frames_per_second", "memory_mb", "stable", "failed_scenes", "failure",
    "error", "value", "low", "high", "pareto", "pareto_probability",
)  # fmt: skip
"""Columns of `csv_text`: one row for each point and error."""


def csv_text(points: Sequence[Point], scenes: Scenes) -> str:
    """One row for each point and error, tidy; lengths in domain length, empty where a value is not known.

    Points that failed in a scene have their errors' columns empty.
    """
    out = io.StringIO()
    writer = csv.DictWriter(out, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for measure in measure_names(points):
        where = standings(points, measure)
        for point in points:
            row = _row(point, scenes) | {"error": measure}
            if point.name in where:
                one = where[point.name]
                row |= {"value": one.mean, "low": one.low, "high": one.high}
                if point.competes:
                    row |= {"pareto": one.member, "pareto_probability": one.probability}
            writer.writerow({name: _plain(value) for name, value in row.items()})
    return out.getvalue()


def _row(point: Point, scenes: Scenes) -> dict[str, object]:
    low, middle, high = point.quartiles
    particles = sorted(recording.frames.shape[1] for recording in scenes.recordings)
    memory = point.times.memory
    return {
        "dataset": scenes.name,
        "scenes": len(scenes),
        "particles": particles[len(particles) // 2],
        "kind": point.kind.value,
        "name": point.name,
        **{name: point.settings.get(name, "") for name in SETTINGS},
        "batch": point.batch,
        "threads": point.threads,
        "device": point.device,
        "hardware": point.times.hardware,
        "clock": point.times.clock,
        "ms_per_frame": middle,
        "ms_lower_quartile": low,
        "ms_upper_quartile": high,
        "ratio_to_reference": point.ratio,
        "ms_per_second": point.milliseconds_per_second,
        "frames_per_second": point.frames_per_second,
        "memory_mb": "" if memory is None else memory / 1e6,
        "stable": point.stable,
        "failed_scenes": len(point.failures),
        "failure": next(iter(point.failures.values()), ""),
    }


def _plain(value: object) -> object:
    """Floats with five digits, empty where they are not finite."""
    if isinstance(value, float | np.floating):
        return f"{value:.5g}" if math.isfinite(value) else ""
    return value


def pareto_table(points: Sequence[Point], scenes: Scenes, measure: str = "mse") -> Table:
    """The points in the Pareto set, or likely to be, and the floors; errors with their interval."""
    where = standings(points, measure)
    shown = [p for p in points if p.name in where and (p.kind is Kind.FLOOR or where[p.name].probability >= 0.05)]
    unit = error_unit(where)
    table = Table(title=f"{scenes.name}: the Pareto set in time and {describe_measure(measure)}", title_justify="left")
    for heading in ("choice", "ms/frame", "quartiles", f"error{unit}", "95%", "in the set"):
        table.add_column(heading, justify="left" if heading == "choice" else "right")
    for point in sorted(shown, key=lambda point: (point.kind is Kind.FLOOR, point.milliseconds)):
        one, (low, middle, high) = where[point.name], point.quartiles
        chance = "floor" if point.kind is Kind.FLOOR else f"{one.probability:.0%}"
        interval = f"{unit.show(one.low, 3)} – {unit.show(one.high, 3)}"
        times = (f"{middle:.3g}", f"{low:.3g} – {high:.3g}")
        table.add_row(point.name, *times, unit.show(one.mean, 3), interval, chance)
    return table


def failure_lines(points: Sequence[Point]) -> list[str]:
    """One line for each point that failed in a scene."""
    return [
        f"{point.name}: unstable in {len(point.failures)} scenes, first in scene {next(iter(point.failures))}:"
        f" {next(iter(point.failures.values()))}"
        for point in points
        if not point.stable
    ]
