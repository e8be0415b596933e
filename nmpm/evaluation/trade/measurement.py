"""Measure a sweep, where it is not stored yet: errors of every choice on all scenes, then times of all in turn."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nmpm._support.atomic import atomic_write
from nmpm._support.messages import one_line
from nmpm._support.progress import Advance, progress_bar
from nmpm.emulator.prescribed import with_predicted
from nmpm.errors import NmpmError
from nmpm.evaluation.machine import clock_for, describe_device, is_machine_failure, one_thread, peak_bytes
from nmpm.evaluation.prediction_errors import Measures, instability, measure_errors, squared_errors
from nmpm.evaluation.trade.choices import Choice, digest, first_forms
from nmpm.evaluation.trade.ranking import Point, Times
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.sweep import Sweep, Timing
from nmpm.metrics.quantities import into_domain

_WARM_UP = 16  # frames: kernels are chosen and code is compiled in them
_TIMES = "times, all choices in turn"


class Store:
    """Measurements in a folder, which is made when something is written."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)

    def read(self, kind: str, key: Any) -> dict[str, Any]:
        """The stored values by name; empty if nothing is, or the file is damaged."""
        try:
            content = json.loads(self._path(kind, key).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        values = content.get("values") if isinstance(content, dict) else None
        return values if isinstance(values, dict) else {}

    def write(self, kind: str, key: Any, values: dict[str, Any]) -> None:
        """Replace what is stored; the key is written beside it."""
        with atomic_write(self._path(kind, key)) as part:
            part.write_text(json.dumps({"key": key, "values": values}, indent=1) + "\n", encoding="utf-8")

    def _path(self, kind: str, key: Any) -> Path:
        return self.folder / "points" / f"{kind}-{digest(key)}.json"


def measure(choices: Sequence[Choice], scenes: Scenes, sweep: Sweep, store: Store, title: str = "trade") -> list[Point]:
    """The points of all choices; the store keeps everything as soon as it is measured, and is not measured again."""
    with progress_bar(title, len(choices) * (len(scenes) + sweep.timing.rounds)) as step:
        rows = [measure_accuracy(choice, scenes, sweep.measures, store, step) for choice in choices]
        times = measure_times(choices, scenes, sweep.timing, store, step)
    return list(map(partial(_point, scenes), choices, rows, times))


def measure_untimed(
    choices: Sequence[Choice], scenes: Scenes, sweep: Sweep, store: Store, title: str = "trade"
) -> list[Point]:
    """As `measure`, errors alone."""
    with progress_bar(title, len(choices) * len(scenes)) as step:
        rows = [measure_accuracy(choice, scenes, sweep.measures, store, step) for choice in choices]
    return [_point(scenes, choice, row, Times()) for choice, row in zip(choices, rows, strict=True)]


def estimate_rest(choices: Sequence[Choice], scenes: Scenes, sweep: Sweep, store: Store) -> tuple[int, float]:
    """How many measurements the store lacks, and about how many seconds they take, by those that it has.

    Those of a model's further forms are taken to be as long as those of its first.
    """
    stored = [store.read("errors", _errors_key(choice, sweep.measures)) for choice in choices]
    models = [str(choice.settings.get("model", choice.name)) for choice in choices]
    seconds: dict[str, list[list[float]]] = {}
    for model, rows in zip(models, stored, strict=True):
        seconds.setdefault(model, []).extend(row["seconds"] for row in rows.values() if "seconds" in row)
    frames = sum(scenes.frames(index) for index in range(len(scenes))) / len(scenes)
    share, count, total = min(1.0, sweep.timing.frames / frames), 0, 0.0
    for choice, model, rows in zip(choices, models, stored, strict=True):
        predicting, measuring = np.quantile(seconds[model] or [[0.0, 0.0]], 0.25, axis=0).tolist()
        lacking = len(set(scenes.digests) - rows.keys())
        times = store.read("times", _times_key(choice, scenes, sweep.timing))
        untimed = sum(str(turn) not in times for turn in range(sweep.timing.rounds)) * ("failed" not in times)
        count += lacking + untimed
        total += lacking * (predicting + measuring) + untimed * choice.batch * share * predicting
    return count, total


def measure_errors_first(
    choices: Sequence[Choice], scenes: Scenes, sweep: Sweep, store: Store, title: str = "trade"
) -> tuple[list[Point], tuple[int, float]]:
    """The errors of each model's first form, as long as the store lacks any measurement; else all, as `measure`.

    Returns:
        The points; and how many measurements are left, with about how many seconds they take: 0 if there are none.
    """
    if not estimate_rest(choices, scenes, sweep, store)[0]:
        return measure(choices, scenes, sweep, store, title), (0, 0.0)
    points = measure_untimed(first_forms(choices), scenes, sweep, store, title)
    return points, estimate_rest(choices, scenes, sweep, store)


def _point(scenes: Scenes, choice: Choice, rows: Sequence[Mapping[str, Any]], times: Times) -> Point:
    length = min(scenes.frames(index) for index in range(len(scenes)))
    names = dict.fromkeys(name for row in rows for name in row.get("errors", {}))
    shown = None
    if "frames" in rows[0]:
        flat = np.frombuffer(base64.b64decode(rows[0]["frames"]), "<f4").astype(np.float64)
        shown = flat.reshape(-1, *scenes.recordings[0].frames.shape[1:])
    return Point(
        kind=choice.kind,
        name=choice.name,
        settings=choice.settings,
        batch=choice.batch,
        device=choice.device.type,
        times=times,
        errors={name: np.array([row.get("errors", {}).get(name, np.nan) for row in rows]) for name in names},
        failures={index: row["failed"] for index, row in enumerate(rows) if "failed" in row},
        curves=np.array([row.get("curve", [np.nan] * length)[:length] for row in rows]),
        frames=shown,
    )


def measure_accuracy(
    choice: Choice, scenes: Scenes, measures: Measures, store: Store, step: Advance
) -> list[dict[str, Any]]:
    """Rows of `_measure_scene`, computed where the store lacks them; calls `step` after every scene."""
    key = _errors_key(choice, measures)
    stored = store.read("errors", key)
    for index, scene in enumerate(scenes.digests):
        if scene not in stored:
            stored[scene] = _measure_scene(choice, scenes, index, measures)
            store.write("errors", key, stored)
        step(f"errors: {choice.name}")
    return [stored[scene] for scene in scenes.digests]


def _errors_key(choice: Choice, measures: Measures) -> dict[str, Any]:
    return {"choice": dict(choice.identity), "measures": measures.to_dict()}


def _measure_scene(choice: Choice, scenes: Scenes, index: int, measures: Measures) -> dict[str, Any]:
    """Errors by name, squared error of each frame and, of the first scene, the shown frames; or why it failed.

    A prediction that gains energy has both: "failed" with the reason, and errors. Frames (F, N, D) are base64 of
    little-endian float32.
    """
    window = with_predicted(scenes.window([index]), choice.bundle)
    start = time.monotonic()
    try:
        predicted, gain = choice.predict(scenes, index)
    except NmpmError as error:
        if is_machine_failure(error):
            raise
        return {"failed": one_line(error)}
    predicting = time.monotonic() - start
    row: dict[str, Any] = {
        "errors": measure_errors(scenes.scene, window, predicted, measures),
        "curve": [float(f"{value:.5g}") for value in squared_errors(window, predicted).tolist()],
    }
    row["seconds"] = [round(predicting, 3), round(time.monotonic() - start - predicting, 3)]  # to predict, to compare
    if reason := instability(gain):
        row["failed"] = reason
    if index == 0:
        shown = into_domain(scenes.scene, predicted[0][scenes.shown_frames()]).numpy().astype("<f4")
        row["frames"] = base64.b64encode(shown.tobytes()).decode("ascii")
    return row


@dataclass(eq=False)
class _Runner:
    """A choice that is timed; stored, under its key, are milliseconds by round, the memory, or why it failed."""

    choice: Choice
    key: dict[str, Any]
    stored: dict[str, Any]
    warm: bool = False


def measure_times(
    choices: Sequence[Choice], scenes: Scenes, timing: Timing, store: Store, step: Advance
) -> list[Times]:
    """The times of all choices; those that lack a round take turns in it, in an order that changes.

    Round r predicts scene r, and the next ones where a choice takes several at once; `step` is called after each run.
    """
    keys = [_times_key(choice, scenes, timing) for choice in choices]
    runners: dict[str, _Runner] = {}  # one for choices that are the same, such as the twin and that many substeps
    for choice, key in zip(choices, keys, strict=True):
        runners.setdefault(digest(key), _Runner(choice, key, store.read("times", key)))
    for turn in range(timing.rounds):
        missing = [r for r in runners.values() if str(turn) not in r.stored and "failed" not in r.stored]
        shift = turn % max(1, len(missing))
        for runner in missing[shift:] + missing[:shift]:
            _time_one(runner, scenes, turn, timing)
            store.write("times", runner.key, runner.stored)
            step(_TIMES)
        step(_TIMES, len(choices) - len(missing))
    return [_times(runners[digest(key)], timing) for key in keys]


def _times(runner: _Runner, timing: Timing) -> Times:
    return Times(
        milliseconds=tuple(runner.stored[str(turn)] for turn in range(timing.rounds) if str(turn) in runner.stored),
        memory=runner.stored.get("memory"),
        clock=runner.key["clock"],
        hardware=runner.key["hardware"],
    )


def _times_key(choice: Choice, scenes: Scenes, timing: Timing) -> dict[str, Any]:
    used = min(len(scenes), timing.rounds - 1 + choice.batch)
    return {
        "choice": dict(choice.identity),
        "scenes": list(scenes.digests[:used]),
        "frames": timing.frames,
        "batch": choice.batch,
        "clock": clock_for(choice.device)[0],
        "hardware": describe_device(choice.device),
        "torch": torch.__version__,
    }


def _time_one(runner: _Runner, scenes: Scenes, turn: int, timing: Timing) -> None:
    """Put down the milliseconds per computed frame and scene, with one thread of torch, or why the choice fails.

    Where the machine fails the error is raised, so that the round is repeated later.
    """
    choice = runner.choice
    indices = [(turn + offset) % len(scenes) for offset in range(choice.batch)]
    frames = min(timing.frames, *(min(scenes.moving_frames(i), scenes.frames(i)) for i in indices))
    _, clock = clock_for(choice.device)
    try:
        with one_thread():
            run = choice.prepare(scenes, indices)
            if not runner.warm:
                run(min(frames, _WARM_UP))
                runner.warm = True
            if "memory" not in runner.stored:
                memory = peak_bytes(lambda: run(frames), choice.device)
                runner.stored["memory"] = memory if memory == memory else None  # (NaN is no JSON)
            start = clock()
            run(frames)
            runner.stored[str(turn)] = 1e3 * (clock() - start) / (choice.computed_frames(frames) * choice.batch)
    except NmpmError as error:
        if is_machine_failure(error):
            raise
        runner.stored["failed"] = str(error)
