"""The report of a sweep: CSV, picture, page, and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nmpm._support.atomic import atomic_write
from nmpm.evaluation.trade.chart import draw_chart
from nmpm.evaluation.trade.frontier import Comparison, advise, compare_with_simulator
from nmpm.evaluation.trade.page import page_text
from nmpm.evaluation.trade.points import Point, measure_names
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.table import csv_text


def write_report(folder: Path, points: Sequence[Point], scenes: Scenes) -> list[Path]:
    """Write trade.csv, trade.png and trade.html into a folder, which is made if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"trade.{suffix}" for suffix in ("csv", "png", "html")]
    with atomic_write(paths[0]) as part:
        part.write_text(csv_text(points, scenes), encoding="utf-8")
    if not measure_names(points):
        return paths[:1]
    draw_chart(paths[1], points, scenes)
    with atomic_write(paths[2]) as part:
        part.write_text(page_text(points, scenes), encoding="utf-8")
    return paths


def advice_lines(points: Sequence[Point], measure: str = "mse") -> list[str]:
    """What to run from which budget on, and the best emulator beside the simulator."""
    lines = [f"from {step.milliseconds:.3g} ms per frame: {step.sentence}" for step in advise(points, measure)[1:]]
    return lines + [_compared(one) for one in compare_with_simulator(points, measure)[:1]]


def _compared(one: Comparison) -> str:
    as_fast, as_good = "no stable simulator setting is as fast", "none is as accurate"
    if one.at_equal_time is not None:
        name, ratio = one.at_equal_time
        as_fast = f"{name} is no slower and has {ratio:.2g} × its error"
    if one.at_equal_error is not None:
        name, ratio = one.at_equal_error
        as_good = f"{name} is no less accurate and takes {ratio:.2g} × its time"
    return f"The most accurate emulator, {one.model}, beside the simulator: {as_fast}; {as_good}."
