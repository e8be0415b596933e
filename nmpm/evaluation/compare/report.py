"""The comparison as files: all figures as JSON, and two pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nmpm._support.atomic import atomic_write
from nmpm.evaluation.compare.measure import MATCHED, shown_frames
from nmpm.evaluation.compare.outcome import Outcome
from nmpm.evaluation.compare.pictures import draw_curves, draw_frames
from nmpm.evaluation.trade.scenes import Scenes


def write_report(folder: Path, outcomes: Sequence[Outcome], scenes: Scenes) -> list[Path]:
    """Write compare.json, errors.png and, of scenes in two dimensions, frames.png into a folder, made if missing."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "compare.json", folder / "errors.png"]
    with atomic_write(paths[0]) as part:
        part.write_text(json.dumps(describe(outcomes, scenes), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    draw_curves(paths[1], outcomes, scenes)
    if scenes.scene.dim > 1:
        paths.append(folder / "frames.png")
        draw_frames(paths[2], outcomes, scenes)
    return paths


def describe(outcomes: Sequence[Outcome], scenes: Scenes) -> dict[str, Any]:
    """All figures as plain data."""
    times = outcomes[0].times
    return {
        "dataset": scenes.name,
        "scenes": len(scenes),
        "particles": [recording.frames.shape[1] for recording in scenes.recordings],
        "frames": [scenes.frames(index) for index in range(len(scenes))],
        "shown_frames": [index + 2 for index in shown_frames(scenes)],
        "emd": f"exact, last frame, of at most {MATCHED} particles of a material",
        "hardware": times.hardware,
        "clock": times.clock,
        "predictors": [outcome.to_dict() for outcome in outcomes],
    }
