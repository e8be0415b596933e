"""What an ensemble of a model's rollouts says about its test scenes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from nmpm.data.format import split_paths
from nmpm.emulator import Prescribed
from nmpm.evaluation.ensembles import EnsembleTest
from nmpm.particles import Window
from nmpm.zoo.measures.scenes import iterate_scenes
from nmpm.zoo.pretrained import Pretrained

MEMBERS = 8
NUDGES = (0.03, 0.1, 0.3)
"""Cells by which starts are displaced, of which the best is taken."""
VALID_SCENES = 4
"""Validation scenes that it is the best in."""


def ensemble_facts(model: Pretrained, data: Path | None) -> dict[str, Any]:
    """The key `ensemble` of a card, see `EnsembleTest.to_dict`; the nudge is calibrated on validation scenes first.

    It takes as long as a rollout of `MEMBERS` times as many scenes, and half as long again for the calibration.
    """
    nudge = None if model.emulator.processor.noise else calibrate_nudge(model, data)
    scenes = iterate_scenes(f"members of {model.name}", model, data)
    return {"ensemble": score_members(model, scenes, MEMBERS, nudge).to_dict()}


def calibrate_nudge(model: Pretrained, data: Path | None) -> float | None:
    """The displacement in cells with the lowest fair CRPS of density; None without validation scenes."""
    if data is not None and "valid" not in split_paths(data):
        return None
    scenes = list(iterate_scenes(f"nudges of {model.name}", model, data, VALID_SCENES, split="valid"))
    crps = {nudge: score_members(model, scenes, MEMBERS, nudge).overall_score() for nudge in NUDGES if scenes}
    return min(crps, key=lambda nudge: crps[nudge], default=None)


def score_members(
    model: Pretrained, scenes: Iterable[Window], members: int, nudge: float | None = None
) -> EnsembleTest:
    """Scores of a model's members in some scenes."""
    test = EnsembleTest(model.emulator, members, nudge)
    for window in scenes:
        predicted = model.rollout(window.initial, window.target.shape[1], Prescribed.of(window)).cpu()
        test.update(window, predicted)
    return test
