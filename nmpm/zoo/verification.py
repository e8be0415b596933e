"""Measure an entry's figures again: its golden rollout, and errors on test scenes simulated from their seeds.

A *golden rollout* is a short rollout stored on the card, which detects changes of weights, statistics or code.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.messages import one_line
from nmpm._support.plain_data import is_number
from nmpm.emulator import Emulator, Prescribed, rollout
from nmpm.emulator.prescribed import with_predicted
from nmpm.errors import ZooError
from nmpm.evaluation.bootstrap import interval
from nmpm.metrics import MSE
from nmpm.particles import thrown_blocks
from nmpm.zoo.card import Rows, read_scenes
from nmpm.zoo.entries import load_entry
from nmpm.zoo.measures.ensemble import score_members
from nmpm.zoo.measures.scenes import iterate_scenes
from nmpm.zoo.optimization import fitting_count
from nmpm.zoo.pretrained import Pretrained

FRAMES, COUNT, PROBES, SEEDS = 32, 300, 8, 8
"""Of the golden rollout: frames, particles, those whose last positions are stored, and scenes to choose from."""
TOLERANCE = 1e-3
"""Largest distance from a stated position, in cells: other processors and versions of torch round differently."""
SHORT_SCENES, SHORT_FRAMES = 2, 100
ROUNDING = 1e-5
"""Relative difference of a mean from the stated one that is tolerated: cards state means in float32."""
RELATIVE = 0.1
"""Relative difference of a scene's MSE at 100 frames and before that is tolerated, as rounding differs."""


@dataclass(frozen=True)
class Check:
    """A stated figure beside the measured one.

    Args:
        name: What was measured.
        stated: On the card.
        measured: Now.
        lowest, highest: Of the measured values that pass.
        stated_by: Words before the stated figure.
    """

    name: str
    stated: float
    measured: float
    lowest: float
    highest: float
    stated_by: str = "the card states"

    @property
    def passed(self) -> bool:
        """Whether the measured value is within the tolerance."""
        return self.lowest <= self.measured <= self.highest

    def __str__(self) -> str:
        outcome = "pass" if self.passed else "FAIL"
        return (
            f"{outcome}  {self.name}: {self.measured:.4g}; {self.stated_by} {self.stated:.4g}, passes from"
            f" {self.lowest:.4g} to {self.highest:.4g}"
        )


def verify_entry(
    folder: Path, full: bool = False, data: Path | None = None, device: torch.device | str = "cpu"
) -> Iterator[Check]:
    """Measure an entry's figures again, see `verify`."""
    yield from verify(load_entry(folder).to(device), read_scenes(folder), full, data)


def verify(model: Pretrained, rows: Rows, full: bool = False, data: Path | None = None) -> Iterator[Check]:
    """Measure a model's figures again.

    Args:
        model: With its card.
        rows: The stated errors of its test scenes, in their order.
        full: All test scenes to their end, the mean within the 95% interval over scenes, instead of the first 100
            frames of the first few, each within 10%; and the scores of members that the card states.
        data: Folder of recorded data that the model was tested on; simulated scenes need none.

    Raises:
        ConfigError: if the test scenes cannot be had: recorded data without `data`.
        DataError: if the data cannot be read.
        ZooError: if the card is malformed, or nothing is stated of the test scenes that can be measured.
    """
    distance = golden_distance(model, model.card.get("golden"))
    yield Check(
        f"golden rollout of {FRAMES} frames, repeated: largest distance in cells", 0.0, distance, 0.0, TOLERANCE
    )
    yield from _headline(model, rows)
    frames, count = (None, len(rows)) if full else (SHORT_FRAMES, SHORT_SCENES)
    metric = MSE()
    for window in iterate_scenes(f"Verifying {model.name}", model, data, count, frames):
        predicted = model.rollout(window.initial, window.target.shape[1], Prescribed.of(window)).cpu()
        metric.update(with_predicted(window, model.emulator.frames), predicted)
    compare = _means if full else _scenes
    checks = list(compare(rows, metric.per_trajectory()))
    if not checks:
        more = "" if full else "; --full measures the whole scenes"
        raise ZooError(f"{model.name}: no error of a test scene is stated that was measured{more}.")
    yield from checks
    if full and "scores" in (stated := model.card.get("ensemble") or {}):
        yield from _members(model, stated, data)


def _members(model: Pretrained, stated: Mapping[str, Any], data: Path | None) -> Iterator[Check]:
    """The fair CRPS of each quantity and frame on the card, which passes within its interval."""
    scenes = iterate_scenes(f"Verifying members of {model.name}", model, data)
    measured = score_members(model, scenes, stated["members"], stated.get("nudge")).to_dict()["scores"]
    for name, scores in stated["scores"].items():
        crps = measured[name]["crps"] if name in measured else math.nan
        yield Check(f"fair CRPS of {name}, {stated['members']} members", scores["crps"], crps, *scores["interval"])


def _headline(model: Pretrained, rows: Rows) -> Iterator[Check]:
    """The figures of the card that are not the means of scenes.csv beside it; nothing is run for this."""
    test = model.card.get("test")
    figures = {name: value for name, value in test.items() if "/" not in name} if isinstance(test, Mapping) else {}
    if "mse" not in figures or not all(map(is_number, figures.values())):
        raise ZooError(f"{model.name}: test of its card should state figures by name, such as mse.")
    for name, stated in figures.items():
        values = [row[name] for row in rows if name in row]
        mean = float(np.mean(values)) if values else math.nan
        bounds = sorted((1 + sign * ROUNDING) * stated for sign in (-1, 1))
        check = Check(f"test {name}, as the mean over {len(rows)} test scenes of scenes.csv", stated, mean, *bounds)
        if not check.passed:
            yield check


def _scenes(rows: Rows, errors: Rows) -> Iterator[Check]:
    for index, (row, measured) in enumerate(zip(rows, errors, strict=False)):
        for name in (name for name in row if "@" in name and name != "mse@1" and name in measured):
            stated = row[name]
            bounds = ((1 - RELATIVE) * stated, (1 + RELATIVE) * stated)
            yield Check(f"test scene {index}, rolled out: {name}", stated, measured[name], *bounds)


def _means(rows: Rows, errors: Rows) -> Iterator[Check]:
    for name in (name for name in rows[0] if name != "mse@1"):
        stated = [row[name] for row in rows if name in row]
        measured = [row[name] for row in errors if name in row]
        low, high = interval(stated)
        mean = math.nan if len(measured) < len(stated) else float(np.mean(measured))
        yield Check(f"{len(stated)} test scenes, rolled out: {name}", float(np.mean(stated)), mean, low, high)


def golden_rollout(emulator: Emulator) -> dict[str, Any]:
    """The last positions of some particles in a rollout of a thrown block, with what determines it.

    Of the first scenes it is the one that deforms the block most: what flies freely would hardly show that a network's
    output has changed.
    """
    count = fitting_count(emulator, COUNT, blocks=1)
    paths = [_positions(emulator, seed, count, FRAMES) for seed in range(SEEDS)]
    deformation = []
    for seed, last in enumerate(paths):
        first = thrown_blocks(emulator.scene, count, seed=seed).position[0].double()
        deformation.append(float((last - _probes(first)).std(0).norm()))
    seed = int(np.argmax(deformation))
    return {"seed": seed, "count": count, "frames": FRAMES, "position": paths[seed].tolist()}


def golden_distance(model: Pretrained, golden: Any) -> float:
    """Largest distance of a model's rollout from a stated one, in cells.

    Raises:
        ZooError: if what is stated is not such a rollout.
    """
    try:
        seed, count, frames = (int(golden[key]) for key in ("seed", "count", "frames"))
        stated = torch.tensor(golden["position"], dtype=torch.float64)
    except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        reason = one_line(repr(error))
        raise ZooError(f"{model.name}: the golden rollout of its card cannot be read: {reason}.") from error
    if stated.shape != (PROBES, model.scene.dim) or seed < 0 or count < 1 or not 1 <= frames <= FRAMES:
        raise ZooError(
            f"{model.name}: the golden rollout of its card should have a seed, a count, up to {FRAMES} frames and"
            f" {PROBES} positions in {model.scene.dim} dimensions."
        )
    spacing = torch.tensor(model.emulator.grid.spacing, dtype=torch.float64)
    try:
        last = _positions(model.emulator, seed, count, frames)
    except ValueError as error:  # such as more particles than fit
        raise ZooError(f"{model.name}: the golden rollout of its card cannot be repeated: {error}") from error
    return float(((last - stated) / spacing).norm(dim=-1).max())


def _positions(emulator: Emulator, seed: int, count: int, frames: int) -> Tensor:
    """(PROBES, D) positions, rounded to 1e-7; 0 of particles that have left through an open axis."""
    state = thrown_blocks(emulator.scene, count, seed=seed)  # weightless where gravity varies, as cards state it
    last = rollout(emulator, state.to(emulator.device), frames)[0, -1].double().cpu()
    if "open" in emulator.scene.boundary:
        last = last.nan_to_num(0.0)  # of particles that have left
    return _probes(last).mul(1e7).round().div(1e7)


def _probes(position: Tensor) -> Tensor:
    """Some of the particles (N, D)."""
    return position[torch.linspace(0, len(position) - 1, PROBES).long()]
