"""The report of a sweep: CSV, picture, page, and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nmpm._support.atomic import atomic_write
from nmpm.evaluation.trade.chart import draw_chart
from nmpm.evaluation.trade.frontier import Comparison, advise, compare_with_simulator
from nmpm.evaluation.trade.points import Point, measure_names
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.table import csv_text


def write_report(folder: Path, points: Sequence[Point], scenes: Scenes) -> list[Path]:
    """Write trade.csv and trade.png into a folder, which is made if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"trade.{suffix}" for suffix in ("csv", "png")]
    with atomic_write(paths[0]) as part:
        part.write_text(csv_text(points, scenes), encoding="utf-8")
    if measure_names(points):
        draw_chart(paths[1], points, scenes)
    return paths


def advice_lines(points: Sequence[Point], measure: str = "mse") -> list[str]:
    """What to run from which budget on, and the best emulator beside the simulator."""
    lines = [f"from {step.milliseconds:.3g} ms per frame: {step.sentence}" for step in advise(points, measure)[1:]]
    return lines + [_compared(one) for one in compare_with_simulator(points, measure)[:1]]


def _compared(one: Comparison) -> str:
    time, error = one.at_equal_time, one.at_equal_error
    as_fast = "no stable simulator setting is as fast" if time is None else f"{time[0]} is no slower and has {time[1]:.2g} × its error"
    as_good = "none is as accurate" if error is None else f"{error[0]} is no less accurate and takes {error[1]:.2g} × its time"
    return f"The most accurate emulator, {one.model}, beside the simulator: {as_fast}; {as_good}."
