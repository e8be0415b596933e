"""The comparison as a table for people."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table

from nmpm.evaluation.compare.measure import HORIZONS
from nmpm.evaluation.compare.outcome import Outcome
from nmpm.evaluation.trade.scenes import Scenes


def outcome_table(outcomes: Sequence[Outcome], scenes: Scenes) -> Table:
    """One row for each predictor; squared errors × 10⁻³ in length², the full rollout's with its interval."""
    frames = max(scenes.frames(index) for index in range(len(scenes)))
    horizons = [h for h in HORIZONS if h < frames]
    table = Table(
        title=_title(scenes), caption=_CAPTION, title_justify="left", caption_justify="left", box=SIMPLE_HEAD,
        padding=0, collapse_padding=True,
    )  # fmt: skip
    table.add_column("predictor", overflow="fold")
    for heading in (*(f"MSE@{h}" for h in horizons), f"MSE@{frames} (95%)", "EMD", "height", "ms/frame"):
        table.add_column(heading, justify="right", no_wrap=True)
    for outcome in outcomes:
        table.add_row(outcome.name, *_figures(outcome, horizons))
    return table


_CAPTION = (
    "MSE × 10⁻³ of frames 1 to h. EMD × 10⁻³: exact earth mover's distance in the last frame. Height: deviation of the"
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


def _figures(outcome: Outcome, horizons: Sequence[int]) -> list[str]:
    time = outcome.milliseconds[1]
    timed = f"{time:.3g}" if math.isfinite(time) else ""
    if outcome.candidate.reproduces:
        return [*("" for _ in horizons), "made the scenes", "", "", timed]
    low, high = outcome.interval("mse")
    full = _thousandth(outcome.mean("mse"))
    spread = f" ({_thousandth(low)}–{_thousandth(high)})" if math.isfinite(low) and low < high else ""
    height = outcome.mean("height")
    return [
        *(_thousandth(outcome.mean(f"mse@{h}")) for h in horizons),
        full + spread,
        _thousandth(outcome.mean("emd")),
        f"{height:.0%}" if math.isfinite(height) else "",
        timed,
    ]


def _thousandth(value: float) -> str:
    if not math.isfinite(value):
        return ""
    return f"{1e3 * value:.3g}" if value == 0 or value >= 1e-6 else f"{1e3 * value:.0e}"
