"""A model's errors on its test scenes beside the squared ones, with pictures, and its stress tests."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from nmpm._support.progress import progress_bar
from nmpm.evaluation.bootstrap import interval
from nmpm.evaluation.pictures import labelled_trajectories
from nmpm.evaluation.prediction_errors import Measures, measure_errors
from nmpm.evaluation.stress import GROUPS, QUICK, ModelUnderTest, TestResult, battery
from nmpm.evaluation.stress.results import as_json
from nmpm.particles import Window
from nmpm.sim import Preset, load_preset, preset_names
from nmpm.viz import write_snapshots
from nmpm.zoo.card import stress_digest
from nmpm.zoo.measures.scenes import track_test_scenes
from nmpm.zoo.pretrained import Pretrained

FIRST, WORST = "rollout.png", "worst.png"
"""Pictures of the first test scene and of that with the largest error."""
EMD_FRAMES = 3
_SETTLING = "settling"


def quality_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:
    """The key `quality` of a card, and pictures of test scenes beside their predictions: the first, and the worst.

    Returns:
        `quality`: for each of `emd` (domain length), `kinetic`, `height` and `crowding` (relative), the mean over the
        test scenes and the ends of its 95% interval; under `worst` the index of the `scene` with the largest `mse`.
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
    names = [name for name in rows[0] if name != "mse" and all(name in row for row in rows)]
    index = int(np.argmax([row["mse"] for row in rows]))
    means = {name: float(np.mean([row[name] for row in rows])) for name in names}
    quality: dict[str, Any] = {name: [mean, *interval([row[name] for row in rows])] for name, mean in means.items()}
    return {"quality": quality | {"worst": {"scene": index, "mse": rows[index]["mse"]}}}


def stress_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The keys `stress` and `stress_free` of a card, see `nmpm stress`; takes minutes, for SPH more than an hour."""
    return _stress(model, load_preset(model.preset) if model.preset in preset_names() else None, "quick")


def invariant_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The same keys from tests of invariants alone, without the simulator: from a thrown block, in minutes."""
    return _stress(model, None, "quick, without the simulator")


def _stress(model: Pretrained, preset: Preset | None, size: str) -> dict[str, Any]:
    constrained = ModelUnderTest(model.name, model.emulator, model.horizon, preset, 0)
    free = constrained.with_emulator(model.emulator.unconstrained())
    others = [name for name in GROUPS if name != _SETTLING]
    with progress_bar(f"stress of {model.name}", len(GROUPS) + len(others)) as advance:
        results = _run_groups(constrained, GROUPS, advance)
        # The last result of this group is the one without constraints; its simulations are most of the battery's time.
        free_results = _run_groups(free, others, advance) | {_SETTLING: results[_SETTLING][-1:]}
    return {"stress": _digest(model, results, size), "stress_free": _digest(model, free_results, size)}


def _run_groups(
    model: ModelUnderTest, names: Iterable[str], advance: Callable[[], object]
) -> dict[str, list[TestResult]]:
    results = {}
    for name in names:
        results[name] = list(battery(model, QUICK, {name: GROUPS[name]}))
        advance()
    return results


def _digest(model: Pretrained, results: dict[str, list[TestResult]], size: str) -> dict[str, Any]:
    ordered = [result for name in GROUPS for result in results[name]]
    return stress_digest(json.loads(as_json(model.name, size, 0.0, ordered)))
