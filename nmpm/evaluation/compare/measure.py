"""Errors of every predictor on all scenes, and times of all in turn, from the store where they are known."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from nmpm._support.messages import one_line
from nmpm.errors import NmpmError
from nmpm.evaluation.compare.outcome import Floats, Outcome
from nmpm.evaluation.compare.predictors import Candidate
from nmpm.evaluation.machine import is_machine_failure
from nmpm.evaluation.trade.accuracy import FAILED
from nmpm.evaluation.trade.choice import Choice, Kind
from nmpm.evaluation.trade.errors import GAIN, Measures, gain_failure, into_domain, measure_errors
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.store import Store
from nmpm.evaluation.trade.timing import Timing, known_times, measure_times
from nmpm.metrics import earth_mover_of_materials

Progress = Callable[[str], object]

HORIZONS = (8, 32, 100)
"""Frames up to which squared errors are quoted, beside the full rollout."""
MATCHED = 2000
"""Particles of a material, drawn at random, that the earth mover's distance matches; its cost grows with their cube."""
TIMING = Timing(rounds=3, frames=64)

_KIND = "compared"
_MEASURES = Measures(HORIZONS, emd_frames=0)
_SHOWN = (0.1, 0.3, 1.0)  # of a rollout: a splash, its return, and how it settles


def count_steps(candidates: Sequence[Candidate], scenes: Scenes, timing: Timing = TIMING) -> int:
    """How often `compare` calls its progress."""
    return len(candidates) * (len(scenes) + timing.rounds)


def compare(
    candidates: Sequence[Candidate], scenes: Scenes, store: Store, progress: Progress, timing: Timing = TIMING
) -> list[Outcome]:
    """The outcomes of all predictors; what the store knows is not measured again.

    Args:
        candidates: Of `make_predictors`; ratios of times are over the first.
        scenes: What is predicted.
        store: Keeps everything as soon as it is measured.
        progress: Told what was done.
        timing: Rounds and frames of the times.
    """
    for candidate in sorted(candidates, key=lambda one: one.choice.kind is Kind.FLOOR):  # simulations last, as slowest
        _measure_candidate(candidate, scenes, store, progress)
    choices = [candidate.choice for candidate in candidates]
    for _ in measure_times(choices, choices[0], scenes, timing, store):
        progress("times, all in turn")
    return [_collect(candidate, scenes, store, timing) for candidate in candidates]


def shown_frames(scenes: Scenes) -> list[int]:
    """Indices of the predicted frames of the first scene that pictures show."""
    last = scenes.frames(0) - 1
    return sorted({round(share * last) for share in _SHOWN})


def _measure_candidate(candidate: Candidate, scenes: Scenes, store: Store, progress: Progress) -> None:
    known = store.read(_KIND, _key(candidate.choice))
    for index, scene in enumerate(scenes.digests):
        if scene not in known and not candidate.reproduces:
            known[scene] = _measure_scene(candidate.choice, scenes, index)
            store.write(_KIND, _key(candidate.choice), known)
        progress(f"errors: {candidate.choice.name}")


def _key(choice: Choice) -> dict[str, Any]:
    return {"choice": dict(choice.identity), "measures": _MEASURES.to_dict(), "matched": MATCHED}


def _measure_scene(choice: Choice, scenes: Scenes, index: int) -> dict[str, Any]:
    """Errors, the error's curve and, of the first scene, the shown frames; "failed" with the reason."""
    window = scenes.window([index])
    try:
        prediction = choice.predict(scenes, index, scenes.frames(index))
    except NmpmError as error:
        if is_machine_failure(error):
            raise
        return {FAILED: one_line(error)}
    predicted, moving = prediction.position, window.mask[0]
    ours, theirs = predicted[0, :, moving], window.target[0, :, moving]
    errors: dict[str, float] = measure_errors(scenes.scene, window, predicted, _MEASURES)
    errors["emd"] = earth_mover_of_materials(ours[-1:], theirs[-1:], window.material[0, moving], MATCHED)
    followed = errors.pop(GAIN)
    failure = gain_failure(followed if prediction.gain is None else prediction.gain)
    curve = (ours - theirs).double().square().mean((1, 2))
    found: dict[str, Any] = {"errors": errors, "curve": [float(f"{value:.5g}") for value in curve.tolist()]}
    if failure:
        found[FAILED] = failure
    if index == 0:
        found["frames"] = _pack(into_domain(scenes.scene, ours[shown_frames(scenes)]))
    return found


def _collect(candidate: Candidate, scenes: Scenes, store: Store, timing: Timing) -> Outcome:
    times = known_times(candidate.choice, scenes, timing, store)
    length = min(scenes.frames(index) for index in range(len(scenes)))
    if candidate.reproduces:
        shown = scenes.recordings[0].frames[2:][shown_frames(scenes)].double().numpy()
        return Outcome(candidate, {"mse": np.zeros(len(scenes))}, np.zeros((len(scenes), length)), shown, {}, times)
    known = store.read(_KIND, _key(candidate.choice))
    rows = [known.get(scene, {}) for scene in scenes.digests]
    nothing = [np.nan] * length
    return Outcome(
        candidate,
        errors=_columns([row.get("errors", {}) for row in rows]),
        curves=np.array([row.get("curve", nothing)[:length] for row in rows]),
        frames=_unpack(rows[0].get("frames"), scenes),
        failures={index: row[FAILED] for index, row in enumerate(rows) if FAILED in row},
        times=times,
    )


def _columns(rows: Sequence[Mapping[str, float]]) -> dict[str, Floats]:
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}


def _pack(frames: Tensor) -> str:
    """Positions (F, N, D) as base64 of little-endian float32."""
    return base64.b64encode(frames.contiguous().numpy().astype("<f4").tobytes()).decode("ascii")


def _unpack(text: str | None, scenes: Scenes) -> Floats | None:
    if text is None:
        return None
    particles, dim = scenes.recordings[0].frames.shape[1:]
    flat = np.frombuffer(base64.b64decode(text), "<f4").astype(np.float64)
    return flat.reshape(-1, particles, dim)
