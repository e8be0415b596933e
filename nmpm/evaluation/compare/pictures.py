"""The comparison as pictures: error against frames, and frames of the first scene beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nmpm._support.atomic import atomic_write
from nmpm.evaluation.compare.measure import shown_frames
from nmpm.evaluation.compare.outcome import Floats, Outcome
from nmpm.evaluation.trade.choice import Kind
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.viz.panel import PanelRenderer
from nmpm.viz.trajectories import LabelledTrajectories

_STYLES: Mapping[Kind, dict[str, Any]] = MappingProxyType(
    {
        Kind.MODEL: {"lw": 1.6},
        Kind.TRIVIAL: {"lw": 1.0, "linestyle": "--", "color": "0.55"},
        Kind.FLOOR: {"lw": 1.0, "linestyle": ":", "color": "#3a8a4a"},
    }
)
_TRIVIAL_COLOURS = ("0.35", "0.65")
_PANEL = 420  # pixels of a square panel's side
_DPI = 130


def draw_curves(path: Path, outcomes: Sequence[Outcome], scenes: Scenes) -> None:
    """Write a PNG: squared error of each frame, a mean over scenes, on a logarithmic axis."""
    figure = Figure(figsize=(7, 4), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    greys = iter(_TRIVIAL_COLOURS)
    for outcome in outcomes:
        curve = 1e3 * outcome.curves.mean(0)
        if outcome.candidate.reproduces or not np.isfinite(curve).all():
            continue
        style = dict(_STYLES[outcome.kind])
        if outcome.kind is Kind.TRIVIAL:
            style["color"] = next(greys, "0.65")
        axes.plot(np.arange(1, len(curve) + 1), curve, label=outcome.name, **style)
    axes.set(
        yscale="log", xlabel="predicted frame", ylabel="squared error × 10⁻³ (length²)",
        title=f"{scenes.name}: mean of {len(scenes)} test scenes",
    )  # fmt: skip
    axes.set_ylim(bottom=1e-3)
    axes.grid(visible=True, color="0.92", lw=0.6)
    axes.legend(frameon=False, fontsize="small")
    with atomic_write(path) as part:
        figure.savefig(part, format="png")


def draw_frames(path: Path, outcomes: Sequence[Outcome], scenes: Scenes) -> None:
    """Write a PNG: a column for the scene as it was made and one for each model, a row for each shown frame."""
    shown = shown_frames(scenes)
    recorded = scenes.recordings[0].frames[2:][shown].numpy()
    columns: dict[str, Floats] = {"data": recorded}
    for outcome in outcomes:
        if outcome.kind is Kind.MODEL and outcome.frames is not None:
            columns[outcome.name] = outcome.frames
    width = max(_PANEL, round(_PANEL * _aspect(scenes) ** 0.5))
    panel = PanelRenderer(_trajectories(columns, scenes), width)
    size = (len(columns) * width / 200, len(shown) * panel.height / 200 + 0.3)
    figure = Figure(figsize=size, dpi=200, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(shown), len(columns), squeeze=False)
    for column, (name, frames) in zip(grid.T, columns.items(), strict=True):
        column[0].set_title(name, fontsize=8)
        for axes, frame, position in zip(column, shown, frames, strict=True):
            axes.imshow(panel.draw(position))
            axes.set(xticks=[], yticks=[])
            axes.set_ylabel(f"frame {frame + 2}" if axes in grid[:, 0] else "", fontsize=8)
            axes.spines[:].set_visible(False)
    with atomic_write(path) as part:
        figure.savefig(part, format="png")


def _trajectories(columns: Mapping[str, Floats], scenes: Scenes) -> LabelledTrajectories:
    first = scenes.recordings[0]
    obstacle = first.obstacle.numpy() if len(first.obstacle) else None
    material, gravity = first.material.numpy(), first.gravity.tolist()
    return LabelledTrajectories.from_scene(scenes.scene, columns, material, obstacle, gravity=gravity)


def _aspect(scenes: Scenes) -> float:
    (left, right), (low, high) = scenes.scene.domain[:2]
    return (right - left) / (high - low)
