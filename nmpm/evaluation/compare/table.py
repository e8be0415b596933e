"""The comparison as a table for people."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table

from nmpm.evaluation.compare.measure import HORIZONS
from nmpm.evaluation.compare.outcome import Outcome
from nmpm.evaluation.figures import Unit
from nmpm.evaluation.trade.scenes import Scenes


def outcome_table(outcomes: Sequence[Outcome], scenes: Scenes) -> Table:
    """One row for each predictor; squared errors in length², in one unit, the full rollout's with its interval."""
    frames = max(scenes.frames(index) for index in range(len(scenes)))
    horizons = [h for h in HORIZONS if h < frames]
    unit = Unit.of([one.mean(n) for one in outcomes for n in (*(f"mse@{h}" for h in horizons), "mse", "emd")])
    table = Table(
        title=_title(scenes), caption=_CAPTION.format(unit=unit), title_justify="left", caption_justify="left",
        box=SIMPLE_HEAD, padding=0, collapse_padding=True,
    )  # fmt: skip
    table.add_column("predictor", overflow="fold")
    for heading in (*(f"MSE@{h}" for h in horizons), f"MSE@{frames} (95%)", "EMD", "height", "ms/frame"):
        table.add_column(heading, justify="right", no_wrap=True)
    for outcome in outcomes:
        table.add_row(outcome.name, *_figures(outcome, horizons, unit))
    return table


_CAPTION = (
    "MSE{unit} of frames 1 to h. EMD{unit}: exact earth mover's distance in the last frame. Height: deviation of the"
    " particles' mean height in the last frame. ms/frame: median, one scene at a time."
)


def origin_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """One line for each model that was trained on other scenes."""
    return [
        f"{one.name}: trained on other scenes; what differs: {', '.join(one.candidate.differing)}"
        for one in outcomes
        if one.candidate.differing
    ]


def failure_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """One line for each predictor that failed in a scene."""
    return [
        f"{one.name}: unstable in {len(one.failures)} scenes, first in scene {next(iter(one.failures))}:"
        f" {next(iter(one.failures.values()))}"
        for one in outcomes
        if one.failures
    ]


def _title(scenes: Scenes) -> str:
    counts = sorted(recording.frames.shape[1] for recording in scenes.recordings)
    particles = f"{counts[0]}" if counts[0] == counts[-1] else f"{counts[0]} to {counts[-1]}"
    return f"{scenes.name}: {len(scenes)} test scenes of {particles} particles"


def _figures(outcome: Outcome, horizons: Sequence[int], unit: Unit) -> list[str]:
    time = outcome.milliseconds[1]
    timed = f"{time:.3g}" if math.isfinite(time) else ""
    if outcome.candidate.reproduces:
        return [*("" for _ in horizons), "made the scenes", "", "", timed]
    low, high = outcome.interval("mse")
    full = _show(outcome.mean("mse"), unit)
    spread = f" ({_show(low, unit)}–{_show(high, unit)})" if math.isfinite(low) and low < high else ""
    height = outcome.mean("height")
    return [
        *(_show(outcome.mean(f"mse@{h}"), unit) for h in horizons),
        full + spread,
        _show(outcome.mean("emd"), unit),
        f"{height:.0%}" if math.isfinite(height) else "",
        timed,
    ]


def _show(value: float, unit: Unit) -> str:
    if not math.isfinite(value):
        return ""
    return unit.show(value, 3 if value == 0 or value >= 1e-3 * 10.0**unit.exponent else 1)
