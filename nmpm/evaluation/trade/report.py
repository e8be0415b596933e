"""The report of a sweep: CSV, JSON, a table for people, sentences, and pictures."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from nmpm._support.atomic import atomic_write
from nmpm.evaluation.bootstrap import interval
from nmpm.evaluation.figures import Unit
from nmpm.evaluation.trade.charts import draw_chart, draw_curves, draw_frames, draw_styled_chart
from nmpm.evaluation.trade.choices import Kind
from nmpm.evaluation.trade.ranking import Point, beside_simulator, measure_names, rank, recommend
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.viz.output import PictureStyle

_SETTINGS = ("model", "weights", "precision", "constraints", "cells", "coarser", "substeps", "nudge", "runtime")
_NAME = 12  # least width of the names in a terminal
_WORDS = {
    ", free": " free: without the model's constraints.",
    "twin": " twin: the simulator with other substeps, how accurate the data are.",
    "nudged": " nudged: from slightly other positions; no prediction gets below its error.",
    "batch": " batch: so many scenes at once, ms of each.",
}
"""What words in the names of choices mean, for the table's caption."""
_LIKELY = 0.05  # probability from which on a point may be in the Pareto set


def write_report(
    folder: Path, name: str, points: Sequence[Point], scenes: Scenes, style: PictureStyle | None = None
) -> list[Path]:
    """Write all files of the report into a folder, which is made if it is missing.

    These are NAME.csv, one row for each point and error; NAME.json, all figures of every scene; NAME.md, the table of
    all points and the sentences; where times are measured NAME.png, time and error, and for a style the same as SVG or
    PDF; errors.png and frames.png, see `charts.py`. Pictures are left out where nothing is stable, and frames.png of
    scenes in one dimension.
    """
    folder.mkdir(parents=True, exist_ok=True)
    plain = json.dumps(describe(points, scenes), indent=1, ensure_ascii=False) + "\n"
    texts = {"csv": csv_text(points, scenes), "json": plain, "md": markdown_text(name, points, scenes)}
    for suffix, text in texts.items():
        with atomic_write(folder / f"{name}.{suffix}") as part:
            part.write_text(text, encoding="utf-8")
    paths = [folder / f"{name}.{suffix}" for suffix in texts]
    if measure_names(points):
        pictures: dict[str, Callable[[Path, Sequence[Point], Scenes], None]] = {"errors.png": draw_curves}
        pictures |= {f"{name}.png": draw_chart} if _timed(points) else {}
        pictures |= {"frames.png": draw_frames} if scenes.scene.dim > 1 else {}
        for file, draw in pictures.items():
            draw(folder / file, points, scenes)
        paths += [folder / file for file in pictures]
        if style is not None and _timed(points):
            draw_styled_chart(paths[-1].with_name(name + style.suffix), points, scenes, style)
            paths.append(paths[-1].with_name(name + style.suffix))
    return paths


def _timed(points: Sequence[Point]) -> bool:
    return any(point.times.milliseconds for point in points)


def csv_text(points: Sequence[Point], scenes: Scenes) -> str:
    """One row for each point and error, tidy; lengths in domain length, empty where a value is not known.

    Points that failed in a scene have their errors' columns empty.
    """
    rows = []
    for measure in measure_names(points):
        ranks = rank(points, measure)
        for point in points:
            one = ranks.get(point.name)
            rows.append(
                {
                    **_describe_row(point, scenes),
                    "error": measure,
                    "value": one.mean if one else "",
                    "low": one.low if one else "",
                    "high": one.high if one else "",
                    "pareto": one.member if one and point.competes else "",
                    "pareto_probability": one.probability if one and point.competes else "",
                }
            )
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        figures = {name: _figure(value) for name, value in row.items() if isinstance(value, float)}
        writer.writerow(row | {name: "" if value is None else f"{value:.5g}" for name, value in figures.items()})
    return out.getvalue()


def _describe_row(point: Point, scenes: Scenes) -> dict[str, object]:
    low, middle, high = point.quartiles
    particles = sorted(recording.frames.shape[1] for recording in scenes.recordings)
    memory = point.times.memory
    return {
        "dataset": scenes.name,
        "scenes": len(scenes),
        "particles": particles[len(particles) // 2],
        "kind": point.kind.value,
        "name": point.name,
        **{name: point.settings.get(name, "") for name in _SETTINGS},
        "batch": point.batch,
        "device": point.device,
        "hardware": point.times.hardware,
        "clock": point.times.clock,
        "ms_per_frame": middle,
        "ms_lower_quartile": low,
        "ms_upper_quartile": high,
        "frames_per_second": 1e3 / middle if middle > 0 else "",
        "memory_mb": "" if memory is None else memory / 1e6,
        "stable": point.stable,
        "failed_scenes": len(point.failures),
        "failure": next(iter(point.failures.values()), ""),
    }


def describe(points: Sequence[Point], scenes: Scenes) -> dict[str, Any]:
    """All figures as plain data; lengths in domain length, times in milliseconds; None where there is none."""
    return {
        "dataset": scenes.name,
        "particles": [recording.frames.shape[1] for recording in scenes.recordings],
        "frames": [scenes.frames(index) for index in range(len(scenes))],
        "shown_frames": [index + 2 for index in scenes.shown_frames()],
        "hardware": points[0].times.hardware,
        "clock": points[0].times.clock,
        "predictors": [_describe_point(point) for point in points],
    }


def _describe_point(point: Point) -> dict[str, Any]:
    low, middle, high = map(_figure, point.quartiles)
    return {
        "name": point.name,
        "kind": point.kind.value,
        "settings": dict(point.settings),
        "batch": point.batch,
        "errors": {
            name: {
                "mean": _figure(point.mean(name)),
                "interval": [_figure(value) for value in interval(values.tolist())],
                "scenes": [_figure(value) for value in values.tolist()],
            }
            for name, values in point.errors.items()
        },
        "ms_per_frame": {"median": middle, "quartiles": [low, high]},
        "failures": {str(scene): reason for scene, reason in point.failures.items()},
        "curve": [_figure(value) for value in point.curves.mean(0).tolist()],
    }


def _figure(value: float) -> float | None:
    return float(f"{value:.5g}") if math.isfinite(value) else None


def likely_points(points: Sequence[Point]) -> list[Point]:
    """The points in the Pareto set of time and MSE, or of time and CRPS, or likely to be, and the floors."""
    by_error = [rank(points, measure) for measure in ("mse", "crps") if measure in {"mse", *measure_names(points)}]
    likely = {name for ranks in by_error for name, one in ranks.items() if one.probability >= _LIKELY}
    return [
        point for point in points if point.name in likely or (point.kind is Kind.FLOOR and point.name in by_error[0])
    ]


def summary_table(shown: Sequence[Point], points: Sequence[Point], scenes: Scenes) -> Table:
    """The table of some of the points for a terminal, see `_summary`; intervals stand on a line of their own."""
    title, caption, headings, rows = _summary(shown, points, scenes)
    table = Table(
        title=title, caption=caption, title_justify="left", caption_justify="left", box=SIMPLE_HEAD, padding=0,
        collapse_padding=True,
    )  # fmt: skip
    table.add_column(headings[0], min_width=_NAME)
    for heading in headings[1:]:
        table.add_column(heading.replace(" ", "\n"), justify="right", no_wrap=True)
    for name, *figures in rows:
        table.add_row(name, *(text.replace(" ", "\n") for text in figures))
    return table


def markdown_text(name: str, points: Sequence[Point], scenes: Scenes) -> str:
    """The table of all points, the sentences and the picture `name`.png, as Markdown."""
    title, caption, headings, rows = _summary(points, points, scenes)
    lines = [" | ".join(cells) for cells in (headings, ["---", *["---:"] * (len(headings) - 1)], *rows)]
    table = "\n".join(f"| {line} |" for line in lines)
    sentences = "\n".join(f"- {line}" for line in report_lines(points))
    picture = f"![Time and error]({name}.png)" if _timed(points) else "![Errors](errors.png)"
    return f"# {title}\n\n{picture}\n\n{table}\n\n{caption}\n\n{sentences}\n"


def _summary(
    shown: Sequence[Point], points: Sequence[Point], scenes: Scenes
) -> tuple[str, str, list[str], list[list[str]]]:
    """Title, caption, headings and rows; floors last, the others in order of their time."""
    counts = sorted(recording.frames.shape[1] for recording in scenes.recordings)
    particles = f"{counts[0]}" if counts[0] == counts[-1] else f"{counts[0]} to {counts[-1]}"
    frames = max(scenes.frames(index) for index in range(len(scenes)))
    horizons = [name for name in measure_names(points) if name.startswith("mse@") and name != f"mse@{frames}"]
    ranks, crps = rank(points), "crps" in measure_names(points)
    unit = Unit.of([point.mean(name) for point in shown for name in (*horizons, "mse", "emd")])

    def show(value: float, digits: int = 3) -> str:
        small = value != 0 and value < 1e-3 * 10.0**unit.exponent
        return unit.show(value, 1 if small else digits) if math.isfinite(value) else ""

    def place(point: Point) -> tuple[bool, float]:
        return point.kind is Kind.FLOOR, point.milliseconds if _timed(points) else point.mean("mse")

    rows = []
    for point in sorted(shown, key=place):
        one, height = ranks.get(point.name), point.mean("height")
        spread = f" ({show(one.low, 2)}–{show(one.high, 2)})" if one and one.low < one.high else ""
        rows.append(
            [
                point.name + " *" * (one is not None and one.probability >= _LIKELY),
                *([f"{point.milliseconds:.3g}" if math.isfinite(point.milliseconds) else ""] if _timed(points) else []),
                *(show(point.mean(name), 2) for name in horizons),
                show(point.mean("mse")) + spread,
                *([f"{1e3 * point.mean('crps'):.3g}"] if crps else []),
                show(point.mean("emd")),
                f"{height:.0%}" if math.isfinite(height) else "",
            ]
        )
    return (
        f"{scenes.name}: {len(scenes)} test scenes of {particles} particles",
        f"MSE{unit} of frames 1 to h. EMD{unit}: earth mover's distance in the last frame. Height: deviation of the"
        " particles' mean height in the last frame."
        + " ms: per frame, median. *: perhaps in the Pareto set." * _timed(points)
        + "".join(text for word, text in _WORDS.items() if any(word in row[0] for row in rows))
        + " CRPS ×10⁻³: fair, of densities; of members ms is of all, MSE of the first." * crps,
        [
            *(
                "choice",
                *["ms"] * _timed(points),
                *(name.replace("mse", "MSE") for name in horizons),
                f"MSE@{frames} (95%)",
            ),
            *(["CRPS"] if crps else []),
            *("EMD", "height"),
        ],
        rows,
    )


def report_lines(points: Sequence[Point]) -> list[str]:
    """Recommendations by budget, the best emulator beside the simulator, models of other scenes, and failures."""
    lines = [f"from {step.milliseconds:.3g} ms per frame: {step.sentence}" for step in recommend(points)]
    lines += filter(None, [beside_simulator(points)])
    origins = {p.settings["model"]: p.settings["scenes_differ_in"] for p in points if p.of_other_scenes}
    lines += [f"{model}: what differs from those of its training: {facts}" for model, facts in origins.items()]
    for point in points:
        if not point.stable:
            scene, reason = next(iter(point.failures.items()))
            lines.append(f"{point.name}: unstable in {len(point.failures)} scenes, first in scene {scene}: {reason}")
    return lines
