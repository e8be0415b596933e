"""Errors of a choice on all scenes, from the store where they are known."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from nmpm._support.messages import one_line
from nmpm.errors import NmpmError
from nmpm.evaluation.machine import is_machine_failure
from nmpm.evaluation.trade.choice import Choice, Prediction
from nmpm.evaluation.trade.errors import GAIN, Measures, gain_failure, into_domain, measure_errors
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.store import Store

FAILED = "failed"
"""Key of the reason for which a scene has no errors, or its prediction is unstable."""

PICTURE = "picture"
_SHOWN = 800  # particles of a thumbnail


def measure_accuracy(choice: Choice, scenes: Scenes, measures: Measures, store: Store) -> Iterator[None]:
    """Measure the errors of each scene that the store lacks; yields after every scene."""
    key = _key(choice, measures)
    known = store.read("errors", key)
    for index, scene in enumerate(scenes.digests):
        if scene not in known:
            known[scene] = _measure_scene(choice, scenes, index, measures, store)
            store.write("errors", key, known)
        yield


def known_accuracy(choice: Choice, scenes: Scenes, measures: Measures, store: Store) -> list[dict[str, Any]]:
    """What is known of each scene: errors by name, "failed" with the reason, "picture" for the first scene."""
    known = store.read("errors", _key(choice, measures))
    return [known.get(scene, {}) for scene in scenes.digests]


def _key(choice: Choice, measures: Measures) -> dict[str, Any]:
    return {"choice": dict(choice.identity), "measures": measures.to_dict()}


def _measure_scene(choice: Choice, scenes: Scenes, index: int, measures: Measures, store: Store) -> dict[str, Any]:
    frames = scenes.frames(index)
    try:
        predicted = _predict(choice, scenes, index, frames, store)
    except NmpmError as error:
        if is_machine_failure(error):
            raise
        return {FAILED: one_line(error)}
    found: dict[str, Any] = dict(measure_errors(scenes.scene, scenes.window([index]), predicted.position, measures))
    if predicted.gain is not None:
        found[GAIN] = predicted.gain
    if failure := gain_failure(found[GAIN]):
        found[FAILED] = failure
    if index == 0:
        found[PICTURE] = thumbnail(scenes, predicted.position[0, shown_frame(scenes)])
    return found


def _predict(choice: Choice, scenes: Scenes, index: int, frames: int, store: Store) -> Prediction:
    key, scene = dict(choice.identity), scenes.digests[index]
    stored = store.read_prediction(key, scene, frames)
    if stored is not None:
        return stored
    predicted = choice.predict(scenes, index, frames)
    store.write_prediction(key, scene, predicted)
    return predicted


def shown_frame(scenes: Scenes) -> int:
    """Index of the predicted frame of the first scene that thumbnails show: half-way through its motion."""
    return min(scenes.moving_frames(0) // 2, scenes.frames(0) - 1)


def thumbnail(scenes: Scenes, position: Tensor) -> str:
    """Positions (N, D) along the first two axes in 256 steps of the domain, as base64; a part of many particles."""
    every = -(-position.shape[0] // _SHOWN)
    inside = into_domain(scenes.scene, position[::every])
    low, high = position.new_tensor(scenes.scene.domain)[:2].T
    steps = ((inside[:, :2] - low) / (high - low) * 255).round().clamp(0, 255).to(torch.uint8)
    return base64.b64encode(steps.numpy().tobytes()).decode("ascii")
