"""Measure the figures of a card again: the golden rollout, and errors on test scenes simulated from their seeds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from nmpm._support.progress import progress_bar
from nmpm.errors import ZooError
from nmpm.evaluation.bootstrap import interval
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.zoo.golden import TOLERANCE, golden_distance
from nmpm.zoo.pretrained import Pretrained
from nmpm.zoo.scenes import Rows, is_figures, iterate_test_scenes, stated_rows

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
    """

    name: str
    stated: float
    measured: float
    lowest: float
    highest: float

    @property
    def passed(self) -> bool:
        """Whether the measured value is within the tolerance."""
        return self.lowest <= self.measured <= self.highest

    def __str__(self) -> str:
        outcome = "pass" if self.passed else "FAIL"
        return (
            f"{outcome}  {self.name}: {self.measured:.4g}; the card states {self.stated:.4g}, passes from"
            f" {self.lowest:.4g} to {self.highest:.4g}"
        )


def verify(model: Pretrained, full: bool = False, data: Path | None = None) -> Iterator[Check]:
    """Measure a model's card again.

    Args:
        model: Of the zoo, whose card states `per_trajectory` errors of its test scenes in their order.
        full: All test scenes to their end, the mean within the 95% interval over scenes, instead of the first 100
            frames of the first few, each within 10%.
        data: Folder of recorded data that the model was tested on; simulated scenes need none.

    Raises:
        ConfigError: if the test scenes cannot be had: recorded data without `data`.
        DataError: if the data cannot be read.
        ZooError: if the card is malformed, or states nothing of the test scenes that can be measured.
    """
    golden = model.card.get("golden")
    if golden is not None:
        yield Check("golden rollout, largest distance in cells", 0.0, golden_distance(model, golden), 0.0, TOLERANCE)
    rows = stated_rows(model)
    yield from _headline(model, rows)
    frames, count = (None, len(rows)) if full else (SHORT_FRAMES, SHORT_SCENES)
    errors = []
    with progress_bar(f"Verifying {model.name}", count) as step:
        for window in islice(iterate_test_scenes(model, frames, data), count):
            errors.append(_errors(model, window))
            step()
    checks = list(_means(rows, errors) if full else _scenes(rows, errors))
    if not checks:
        more = "" if full else "; --full measures the whole scenes"
        raise ZooError(f"{model.name}: its card states no error of a test scene that was measured{more}.")
    yield from checks


def _headline(model: Pretrained, rows: Rows) -> Iterator[Check]:
    """The figures that cards, tables and choices show beside the means of those of single test scenes.

    Raises:
        ZooError: if the card states none.
    """
    test = model.card.get("test")
    own = {name: value for name, value in test.items() if "/" not in name} if isinstance(test, Mapping) else {}
    if "mse" not in own or not is_figures(own):
        raise ZooError(f"{model.name}: test of its card should state figures by name, such as mse.")
    for name, stated in own.items():
        found = [row[name] for row in rows if name in row]
        mean = float(np.mean(found)) if found else math.nan
        bounds = sorted((1 + sign * ROUNDING) * stated for sign in (-1, 1))
        yield Check(f"test {name}, as the mean over the card's {len(rows)} test scenes", stated, mean, *bounds)


def _scenes(rows: Rows, errors: Rows) -> Iterator[Check]:
    for index, (row, found) in enumerate(zip(rows, errors, strict=False)):
        for name in (name for name in row if "@" in name and name != "mse@1" and name in found):
            stated = row[name]
            bounds = ((1 - RELATIVE) * stated, (1 + RELATIVE) * stated)
            yield Check(f"test scene {index}, {name}", stated, found[name], *bounds)


def _means(rows: Rows, errors: Rows) -> Iterator[Check]:
    for name in (name for name in rows[0] if name != "mse@1"):
        stated = [row[name] for row in rows if name in row]
        found = [row[name] for row in errors if name in row]
        low, high = interval(stated)
        mean = math.nan if len(found) < len(stated) else float(np.mean(found))
        yield Check(f"{name} over {len(stated)} test scenes", float(np.mean(stated)), mean, low, high)


def _errors(model: Pretrained, window: Window) -> dict[str, float]:
    metric = MSE()
    device = model.emulator.device
    metric.update(window, model.rollout(window.initial.to(device), window.target.shape[1]).cpu())
    return metric.per_trajectory()[0]
