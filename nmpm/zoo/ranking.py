"""Which pretrained models predict a dataset best as they are: short rollouts of all of them, matched to the data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import torch
from torch import Tensor

from nmpm._support.messages import one_line
from nmpm.data.dataset import Dataset
from nmpm.data.format import split_paths
from nmpm.data.loading.padded_batch import PaddedRecordings, displacements
from nmpm.data.loading.recording import Recording
from nmpm.data.motion import measure_motion
from nmpm.emulator import Emulator
from nmpm.emulator.prescribed import predict_from_entries, with_predicted
from nmpm.emulator.similarity import Match, find_match
from nmpm.errors import ConfigError, NmpmError
from nmpm.evaluation.comparison import free_fall, still
from nmpm.evaluation.matched import MatchedPredictor, describe_match
from nmpm.particles import Window
from nmpm.scene import Motion, Scene

FRAMES = 32
"""Frames of the data that are predicted, or as many as there are."""
_WINDOWS = 3
_MOVING = 0.02
"""A trajectory moves while its mean speed is at least this share of its largest."""


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
            mean_squared_error(predict_from_entries(predictor, window, 1), with_predicted(window, 1))
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
        last = min(_moving_frames(recording, scene), len(recording.frames)) - length
        starts.append(max(0, round(last * number / len(recordings))))
    return PaddedRecordings.stack(recordings, scene).gather(range(len(recordings)), starts, length)


def _moving_frames(recording: Recording, scene: Scene) -> int:
    speed = displacements(recording.frames, scene).square().sum(-1).mean(-1).sqrt()
    moving = (speed >= _MOVING * speed.max()).nonzero()
    return int(moving[-1]) + 2 if len(moving) else 0


def mean_squared_error(predicted: Tensor, window: Window) -> float:
    """Mean over windows, frames, present particles and axes, in length²; of (B, T - 2, N, D) positions."""
    there = window.mask.unsqueeze(1) if window.present is None else window.present[:, 2:] & window.mask.unsqueeze(1)
    squared = (predicted - window.target).double().square().mean(-1)
    return float(squared[there.expand_as(squared)].mean())


@dataclass(frozen=True)
class Standing:
    """How well a model predicts a dataset as it is.

    Args:
        model: Its name.
        error: Mean squared error over that of the better trivial predictor; infinite where it fails.
        match: How it takes the data; None where it cannot.
        how: The match in a phrase, or why there is none.
        emulator: The model, on its own grid.
        materials: Those that are to be stated for this match; empty where they are proposed.
    """

    model: str
    error: float = math.inf
    match: Match | None = None
    how: str = ""
    materials: Mapping[str, str] | None = None


def rank_models(
    trial: Trial,
    models: Mapping[str, Callable[[], Emulator]],
    materials: Mapping[str, str] | None = None,
    stride: Fraction | None = None,
    step: Callable[[str], object] = lambda _: None,
) -> list[Standing]:
    """The standings of models that load, the best first; of models of other dimensions none.

    Args:
        trial: Of the data.
        models: By name, what loads each.
        materials: As for `find_match`, and so is the next.
        stride: Frames of the data for one of the model.
        step: Called with each model's name.
    """
    standings = []
    for name, load in models.items():
        try:
            emulator = load()
        except NmpmError as error:
            standings.append(Standing(name, how=one_line(error)))
            continue
        if emulator.scene.dim == trial.scene.dim:
            tried = [_try(name, emulator, trial, renamed, stride) for renamed in _mappings(emulator, trial, materials)]
            standings.append(min(tried, key=lambda one: one.error))
        step(name)
    return sorted(standings, key=lambda one: one.error)


def _mappings(
    emulator: Emulator, trial: Trial, materials: Mapping[str, str] | None
) -> Iterator[Mapping[str, str] | None]:
    """The materials that are stated, or else proposed; or else everything as each of the model's in turn."""
    theirs = emulator.scene.materials
    if materials is not None and set(materials.values()) <= set(theirs):
        yield materials
        return
    try:
        find_match(emulator, trial.scene, trial.motion)
    except ConfigError:
        yield from (dict.fromkeys(trial.scene.materials, name) for name in theirs)
    else:
        yield None


def _try(
    name: str, emulator: Emulator, trial: Trial, materials: Mapping[str, str] | None, stride: Fraction | None
) -> Standing:
    try:
        match = find_match(emulator, trial.scene, trial.motion, materials, stride, names=(name, trial.name))
        predictor = MatchedPredictor(emulator.matched(match), match.reading, trial.scene)
        with torch.inference_mode():
            predicted = predictor.predict(trial.window)
    except NmpmError as error:
        return Standing(name, how=one_line(error), materials=materials)
    mean = mean_squared_error(predicted, with_predicted(trial.window, predictor.bundle))
    relative = mean / trial.trivial if math.isfinite(mean) else math.inf
    return Standing(name, relative, match, describe_match(emulator, match), materials)
