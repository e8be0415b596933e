"""Which pretrained models predict a dataset best as they are: short rollouts of all of them, matched to the data."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import torch
from rich.box import SIMPLE_HEAD
from rich.table import Table
from torch import Tensor

from nmpm._support.messages import one_line
from nmpm.data.dataset import Dataset
from nmpm.data.format import split_paths
from nmpm.data.survey import measure_motion
from nmpm.data.windows import PaddedRecordings, Recording
from nmpm.emulator import Emulator
from nmpm.emulator.prescribed import predict_from_entries, with_predicted
from nmpm.emulator.similarity import Match, find_match
from nmpm.errors import ConfigError, NmpmError
from nmpm.evaluation.comparison import free_fall, still
from nmpm.evaluation.matched import MatchedPredictor
from nmpm.evaluation.trade.scenes import moving_frames
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.scene import Motion, Reading, Scene

FRAMES = 32
"""Frames of the data that are predicted, or as many as there are."""
_WINDOWS = 3
_WORDS = ("gravity", "speeds", "particles to a cell", "boundary", "obstacles")
"""Of warnings, in short."""


@dataclass(frozen=True)
class Trial:
    """Windows of a dataset by which models are ranked.

    Args:
        name: Of the dataset.
        scene: The dataset's.
        motion: Its speeds.
        window: One window each of some trajectories.
        still, free_fall: Mean squared errors of the trivial predictors, in length².
    """

    name: str
    scene: Scene
    motion: Motion
    window: Window
    still: float
    free_fall: float

    @classmethod
    def of(cls, data: Dataset) -> Trial:
        """Windows of a few test trajectories, or of the first split that there is, that begin early, midway and late.

        Raises:
            DataError: if no trajectory has three frames.
        """
        splits = split_paths(data.folder)
        split = "test" if "test" in splits else next(iter(splits))
        recordings = data.source.recordings(split).with_frames(3, "a ranking")
        taken = [recordings[number] for number in range(min(_WINDOWS, len(recordings)))]
        window = _windows([taken[turn % len(taken)] for turn in range(_WINDOWS)], data.scene)
        errors = [
            _mean_squared_error(predict_from_entries(predictor, window, 1), with_predicted(window, 1))
            for predictor in (still, partial(free_fall, data.scene))
        ]
        return cls(data.source.path.name, data.scene, measure_motion(data.folder, data.metadata), window, *errors)

    @property
    def frames(self) -> int:
        """Frames that are predicted."""
        return self.window.target.shape[1]

    @property
    def trivial(self) -> float:
        """The error of the better trivial predictor."""
        return min(self.still, self.free_fall)


def _windows(recordings: Sequence[Recording], scene: Scene) -> Window:
    """One window of each recording, beginning at the start of its motion, and at a third and two thirds of it."""
    length = min(FRAMES + 2, *(len(recording.frames) for recording in recordings))
    starts = []
    for number, recording in enumerate(recordings):
        last = moving_frames(recording, scene) + 2 - length
        starts.append(max(0, round(last * number / len(recordings))))
    return PaddedRecordings.stack(recordings, Reading(scene)).gather(range(len(recordings)), starts, length)


def _mean_squared_error(predicted: Tensor, window: Window) -> float:
    error = MSE(())
    error.update(window, predicted)
    return float(error.compute()["mse"])


@dataclass(frozen=True)
class Standing:
    """How well a model predicts a dataset as it is.

    Args:
        model: Its name.
        error: Mean squared error over that of the better trivial predictor; infinite where it fails.
        match: How it takes the data; None where it cannot.
        failure: Why there is no error; else empty.
        stated: The model's material by the data's name, where the names do not tell.
    """

    model: str
    error: float = math.inf
    match: Match | None = None
    failure: str = ""
    stated: Mapping[str, str] | None = None

    def pairs(self, separator: str) -> str:
        """The model's material by the data's name, where the names do not tell, such as "big=sand"."""
        return separator.join(f"{name}={theirs}" for name, theirs in (self.stated or {}).items())


@dataclass(frozen=True)
class Ranking:
    """Tries models on a dataset.

    Args:
        trial: Of the data.
        materials: The model's material by the data's name, of models that have those; see `find_match`.
        stride: Frames of the data for one of the model; the best one if None.
    """

    trial: Trial
    materials: Mapping[str, str] | None = None
    stride: Fraction | None = None

    def rank(self, models: Mapping[str, Callable[[], Emulator]], step: Callable[[str], object]) -> list[Standing]:
        """The standings of models by what loads them, the best first; none of models of another dimension.

        `step` is called with each model's name.
        """
        standings = []
        for name, load in models.items():
            try:
                emulator = load()
                if emulator.scene.dim == self.trial.scene.dim:
                    standings.append(self.best(name, emulator))
            except NmpmError as error:
                standings.append(Standing(name, failure=one_line(error)))
            step(name)
        return sorted(standings, key=lambda one: one.error)

    def best(self, name: str, emulator: Emulator) -> Standing:
        """The standing of one model, with the materials that are stated, or told by names, or the best of a few."""
        theirs = emulator.scene.materials
        if self.materials is not None and set(self.materials.values()) <= set(theirs):
            return self._try(name, emulator, self.materials)
        try:
            find_match(emulator, self.trial.scene, self.trial.motion)
        except ConfigError:
            return self._best_materials(name, emulator)
        return self._try(name, emulator, None)

    def _best_materials(self, name: str, emulator: Emulator) -> Standing:
        """Everything as one of the model's materials, then each of the data's as another, where that is better."""
        names, theirs = self.trial.scene.materials, emulator.scene.materials
        tried = [self._try(name, emulator, dict.fromkeys(names, to)) for to in theirs]
        for changed in names if len(names) > 1 else ():
            best = min(tried, key=lambda one: one.error).stated or {}
            others = [to for to in theirs if to != best[changed]]
            tried += [self._try(name, emulator, {**best, changed: to}) for to in others]
        return min(tried, key=lambda one: one.error)

    def _try(self, name: str, emulator: Emulator, materials: Mapping[str, str] | None) -> Standing:
        trial = self.trial
        try:
            names = (name, trial.name)
            match = find_match(emulator, trial.scene, trial.motion, materials, self.stride, names=names)
            predictor = MatchedPredictor(emulator.matched(match), match.reading, trial.scene)
            with torch.inference_mode():
                predicted = predictor.predict(trial.window)
        except NmpmError as error:
            return Standing(name, failure=one_line(error), stated=materials)
        mean = _mean_squared_error(predicted, with_predicted(trial.window, predictor.bundle))
        relative, failure = (mean / trial.trivial, "") if math.isfinite(mean) else (math.inf, "not finite")
        return Standing(name, relative, match, failure, materials)


def ranking_table(trial: Trial, standings: Sequence[Standing]) -> Table:
    """The standings as a table, with what could not be matched, and the trivial predictors below."""
    title = (
        f"{trial.name}, {trial.scene.dim}-D models: errors at {trial.frames} frames over that of the better trivial"
        " predictor"
    )
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=0, collapse_padding=True)
    table.add_column("model", no_wrap=True)
    for heading in ("error", "cells", "stride", "gravity"):
        table.add_column(heading, justify="right", no_wrap=True)
    for heading in ("materials", "not matched"):
        table.add_column(heading)
    for one in standings:
        error = f"{one.error:.2g}" if math.isfinite(one.error) else ""
        if one.match is None:
            table.add_row(one.model, error, "", "", "", "", one.failure)
            continue
        reading = one.match.reading
        unmatched = [word for word in _WORDS if any(word in warning.lower() for warning in one.match.warnings)]
        table.add_row(
            one.model,
            error,
            "×".join(map(str, one.match.recipe.grid.shape)),
            str(reading.every) if reading.between == 1 else f"1/{reading.between}",
            "" if one.match.gravity is None else f"× {one.match.gravity:.3g}",
            one.pairs(", "),
            ", ".join([*unmatched, *([one.failure] if one.failure else [])]),
        )
    table.add_row("nothing moves", f"{trial.still / trial.trivial:.2g}")
    table.add_row("free fall", f"{trial.free_fall / trial.trivial:.2g}")
    return table
