"""A model's errors on its test scenes beside the squared ones, with pictures, and its stress tests."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.progress import progress_bar
from nmpm.emulator import Emulator, Prescribed, RolloutOptions, stream_rollout
from nmpm.emulator.prescribed import with_predicted
from nmpm.emulator.trust import Trust, TrustTracker
from nmpm.evaluation.bootstrap import interval
from nmpm.evaluation.pictures import labelled_trajectories
from nmpm.evaluation.prediction_errors import Measures, measure_errors
from nmpm.evaluation.stress import GROUPS
from nmpm.evaluation.stress.model import ModelUnderTest, battery
from nmpm.evaluation.stress.results import QUICK, TestResult
from nmpm.particles import Window
from nmpm.viz import write_snapshots
from nmpm.zoo.card import stress_digest
from nmpm.zoo.measures.scenes import iterate_scenes, simulator_of
from nmpm.zoo.pretrained import Pretrained

FIRST, WORST = "rollout.png", "worst.png"
"""Pictures of the first test scene and of that with the largest error."""
EMD_FRAMES = 3
TRUST_SCENES = 10
"""Most validation scenes that trust is calibrated on."""
_SETTLING = "settling"


def quality_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:
    """The key `quality` of a card, and pictures of test scenes beside their predictions: the first, and the worst.

    Returns:
        `quality`: for each of `emd` (domain length), `kinetic`, `height` and `crowding` (relative), the mean over the
        test scenes and the ends of its 95% interval; under `worst` the index of the `scene` with the largest `mse`.
    """
    rows: list[dict[str, float]] = []
    worst: tuple[Window, Tensor] | None = None
    for window in iterate_scenes(f"quality of {model.name}", model, data):
        predicted = model.rollout(window.initial, window.target.shape[1], Prescribed.of(window)).cpu()
        scored = with_predicted(window, model.emulator.frames)
        rows.append(measure_errors(model.scene, scored, predicted, Measures((), EMD_FRAMES)))
        if len(rows) == 1:
            write_snapshots(labelled_trajectories(model.scene, window, predicted), folder / FIRST)
        if worst is None or rows[-1]["mse"] >= max(row["mse"] for row in rows):
            worst = window, predicted
    if worst is not None:
        title = f"{model.name}: the test scene with the largest error"
        write_snapshots(labelled_trajectories(model.scene, *worst, title), folder / WORST)
    quality: dict[str, Any] = {}
    for name in rows[0]:
        values = [row[name] for row in rows if name in row]
        if name != "mse" and len(values) == len(rows):
            quality[name] = [float(np.mean(values)), *interval(values)]
    index = int(np.argmax([row["mse"] for row in rows]))
    return {"quality": quality | {"worst": {"scene": index, "mse": rows[index]["mse"]}}}


def trust_facts(model: Pretrained, data: Path | None) -> dict[str, Any]:
    """The key `trust` of a card, see `nmpm.emulator.trust.Trust`, calibrated on the validation scenes."""
    windows = iterate_scenes(f"trust of {model.name}", model, data, TRUST_SCENES, split="valid")
    return {"trust": calibrate_trust(model.emulator, windows).to_card()}


def calibrate_trust(emulator: Emulator, windows: Iterable[Window]) -> Trust:
    """The trust of an emulator on recorded scenes, each the only one of a window.

    Raises:
        DataError: if there is none.
    """
    members, truth = [], []
    for window in windows:
        state, frames = window.initial, window.target.shape[1]
        beside, apart = (TrustTracker(emulator.scene, state, Trust()) for _ in range(2))
        for part in stream_rollout(emulator, state, frames, RolloutOptions(Prescribed.of(window), tracker=beside)):
            recorded = window.target[:, apart.made : beside.made]
            apart.see(torch.stack([part.position, recorded.to(part.position)]))
        members.append(beside.curve[0])
        truth.append(apart.curve[0])
    return Trust.fit(members, truth)


def stress_facts(model: Pretrained) -> dict[str, Any]:
    """The keys `stress` and `stress_free` of a card, see `nmpm stress`; takes minutes, for SPH more than an hour."""
    return _stress(ModelUnderTest(model.name, model.emulator, model.horizon, simulator_of(model), 0), "quick")


def invariant_facts(model: Pretrained) -> dict[str, Any]:
    """The same keys from tests of invariants alone, without the simulator: from a thrown block, in minutes."""
    tested = ModelUnderTest(model.name, model.emulator, model.horizon, None, 0)
    return _stress(tested, "quick, without the simulator")


def _stress(model: ModelUnderTest, size: str) -> dict[str, Any]:
    free = model.with_emulator(model.emulator.unconstrained())
    results: list[TestResult] = []
    free_results: list[TestResult] = []
    with progress_bar(f"stress of {model.name}", len(GROUPS.built_in)) as advance:
        for name in GROUPS.built_in:
            results += battery(model, QUICK, [name])
            # The last result of settling is without constraints; simulating it again would take most of the time.
            free_results += results[-1:] if name == _SETTLING else battery(free, QUICK, [name])
            advance()
    return {
        "stress": stress_digest(size, map(vars, results)),
        "stress_free": stress_digest(size, map(vars, free_results)),
    }
