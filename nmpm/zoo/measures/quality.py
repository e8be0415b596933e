"""Errors of a model on its test scenes beside the squared ones: earth mover's distance, energy and settled shape."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from nmpm.evaluation.bootstrap import interval
from nmpm.evaluation.pictures import labelled_trajectories
from nmpm.evaluation.trade.errors import GAIN, Measures, measure_errors
from nmpm.particles import Window
from nmpm.viz import write_snapshots
from nmpm.zoo.pretrained import Pretrained
from nmpm.zoo.scenes import track_test_scenes

FIRST, WORST = "rollout.png", "worst.png"
"""Pictures of the first test scene and of that with the largest error."""
EMD_FRAMES = 3


def quality_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:
    """The key `quality` of a card, and pictures of test scenes beside their predictions: the first, and the worst.

    Returns:
        `quality`: for each of `emd` (domain length), `kinetic`, `height` and `crowding` (relative), the `mean` over the
        test scenes, a 95% `interval` of it, and under `worst` the index of the `scene` with the largest `mse`.
    """
    rows: list[dict[str, float]] = []
    worst: tuple[Window, Tensor] | None = None
    for window in track_test_scenes("quality", model, data):
        predicted = model.rollout(window.initial.to(model.emulator.device), window.target.shape[1]).cpu()
        rows.append(measure_errors(model.scene, window, predicted, Measures((), EMD_FRAMES)))
        if len(rows) == 1:
            write_snapshots(labelled_trajectories(model.scene, window, predicted), folder / FIRST)
        if worst is None or rows[-1]["mse"] >= max(row["mse"] for row in rows):
            worst = window, predicted
    if worst is not None:
        title = f"{model.name}: the test scene with the largest error"
        write_snapshots(labelled_trajectories(model.scene, *worst, title), folder / WORST)
    names = [name for name in rows[0] if name not in ("mse", GAIN) and all(name in row for row in rows)]
    index = int(np.argmax([row["mse"] for row in rows]))
    found: dict[str, Any] = {name: _summary([row[name] for row in rows]) for name in names}
    return {"quality": found | {"worst": {"scene": index, "mse": rows[index]["mse"]}}}


def _summary(values: list[float]) -> dict[str, Any]:
    mean = {"mean": float(np.mean(values))}
    return mean | ({"interval": list(interval(values))} if len(values) > 1 else {})
