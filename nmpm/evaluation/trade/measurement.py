"""Measure a sweep, where it is not stored yet: errors of every choice on all scenes, then times of all in turn."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.atomic import atomic_write
from nmpm._support.messages import one_line
from nmpm.errors import NmpmError
from nmpm.evaluation.bootstrap import Floats
from nmpm.evaluation.machine import clock_for, describe_device, is_machine_failure, peak_bytes
from nmpm.evaluation.prediction_errors import (
    Measures,
    instability,
    into_domain,
    measure_errors,
    recorded_energy_gain,
    squared_errors,
)
from nmpm.evaluation.trade.choices import Choice, digest
from nmpm.evaluation.trade.ranking import Point, Times
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.sweep import Sweep, Timing

Progress = Callable[[str], object]
"""Called after each scene of a choice and each timed rollout, with what was done."""

_WARM_UP = 16  # frames: kernels are chosen and code is compiled in them


class Store:
    """Measurements in a folder.

    Args:
        folder: Made when something is written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)

    def read(self, kind: str, key: Any) -> dict[str, Any]:
        """What is stored, by name; empty if nothing is, or the file is damaged."""
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


def count_steps(choices: Sequence[Choice], scenes: Scenes, sweep: Sweep) -> int:
    """How often `measure` calls its progress."""
    return len(choices) * (len(scenes) + sweep.timing.rounds)


def measure(choices: Sequence[Choice], scenes: Scenes, sweep: Sweep, store: Store, progress: Progress) -> list[Point]:
    """The points of all choices; what the store has is not measured again.

    Args:
        choices: Of `make_choices`; times are compared with the first.
        scenes: What is predicted.
        sweep: Measures and timing.
        store: Keeps everything as soon as it is measured.
        progress: Told what was done.
    """
    for choice in choices:
        for _ in measure_accuracy(choice, scenes, sweep.measures, store):
            progress(f"errors: {choice.name}")
    for _ in measure_times(choices, scenes, sweep.timing, store):
        progress("times, all choices in turn")
    return [_point(choice, scenes, sweep, store) for choice in choices]


def _point(choice: Choice, scenes: Scenes, sweep: Sweep, store: Store) -> Point:
    rows = _stored_errors(choice, scenes, sweep.measures, store)
    length = min(scenes.frames(index) for index in range(len(scenes)))
    return Point(
        kind=choice.kind,
        name=choice.name,
        settings=choice.settings,
        batch=choice.batch,
        threads=choice.threads,
        device=choice.device.type,
        times=_stored_times(choice, scenes, sweep.timing, store),
        errors=_columns([row.get("errors", {}) for row in rows]),
        failures={index: row["failed"] for index, row in enumerate(rows) if "failed" in row},
        curves=np.array([row.get("curve", [np.nan] * length)[:length] for row in rows]),
        frames=_unpack(rows[0].get("frames"), scenes),
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


def measure_accuracy(choice: Choice, scenes: Scenes, measures: Measures, store: Store) -> Iterator[None]:
    """Measure the errors of each scene that the store lacks; yields after every scene."""
    key = _errors_key(choice, measures)
    stored = store.read("errors", key)
    for index, scene in enumerate(scenes.digests):
        if scene not in stored:
            stored[scene] = _measure_scene(choice, scenes, index, measures)
            store.write("errors", key, stored)
        yield


def _stored_errors(choice: Choice, scenes: Scenes, measures: Measures, store: Store) -> list[dict[str, Any]]:
    """What the store has of each scene, see `_measure_scene`; empty where it was not measured."""
    stored = store.read("errors", _errors_key(choice, measures))
    return [stored.get(scene, {}) for scene in scenes.digests]


def _errors_key(choice: Choice, measures: Measures) -> dict[str, Any]:
    return {"choice": dict(choice.identity), "measures": measures.to_dict()}


def _measure_scene(choice: Choice, scenes: Scenes, index: int, measures: Measures) -> dict[str, Any]:
    """Errors by name, squared error of each frame and, of the first scene, the shown frames; or why it failed.

    A prediction that gains energy has both: "failed" with the reason, and errors.
    """
    window = scenes.window([index])
    try:
        prediction = choice.predict(scenes, index)
    except NmpmError as error:
        if is_machine_failure(error):
            raise
        return {"failed": one_line(error)}
    predicted, gain = prediction.position, prediction.gain
    row: dict[str, Any] = {
        "errors": measure_errors(scenes.scene, window, predicted, measures),
        "curve": [float(f"{value:.5g}") for value in squared_errors(window, predicted).tolist()],
    }
    if reason := instability(recorded_energy_gain(scenes.scene, window, predicted) if gain is None else gain):
        row["failed"] = reason
    if index == 0:
        row["frames"] = _pack(into_domain(scenes.scene, predicted[0][scenes.shown_frames()]))
    return row


@dataclass
class _Runner:
    """A choice, its key in the store and what is stored: rounds by number, and the memory."""

    choice: Choice
    key: dict[str, Any]
    stored: dict[str, Any] = field(default_factory=dict)

    def lacks(self, turn: int) -> bool:
        return str(turn) not in self.stored and "failed" not in self.stored


def measure_times(choices: Sequence[Choice], scenes: Scenes, timing: Timing, store: Store) -> Iterator[None]:
    """Time all choices that lack a round, in an order that turns; yields after each run.

    Args:
        choices: What to time; ratios of times are over the first, which is timed in each of these rounds.
        scenes: What is predicted: round r predicts scene r, and the next ones where a choice takes several at once.
        timing: Rounds and frames.
        store: Keeps each round's times as soon as the round is complete.
    """
    runners = _make_runners(choices, scenes, timing, store)
    warm: set[int] = set()
    for turn in range(timing.rounds):
        missing = [runner for runner in runners if runner.lacks(turn)]
        needed = [runner for runner in runners if runner in missing or (missing and runner.choice is choices[0])]
        yield from (None for _ in range(len(choices) - len(needed)))
        spent: dict[int, float | None] = {}
        shift = turn % max(1, len(needed))
        for runner in needed[shift:] + needed[:shift]:
            spent[id(runner)] = _time_round(runner, scenes, turn, timing, id(runner) not in warm)
            warm.add(id(runner))
            yield
        reference = next((spent[id(runner)] for runner in needed if runner.choice is choices[0]), None)
        for runner in missing:
            milliseconds = spent[id(runner)]
            if milliseconds is not None:
                runner.stored[str(turn)] = [milliseconds, reference]
            store.write("times", runner.key, runner.stored)


def _make_runners(choices: Sequence[Choice], scenes: Scenes, timing: Timing, store: Store) -> list[_Runner]:
    """One for each choice; one for choices that are the same, such as the twin and that number of substeps."""
    keys = {digest(key): (choice, key) for choice in reversed(choices) for key in [_times_key(choice, scenes, timing)]}
    return [_Runner(choice, key, store.read("times", key)) for choice, key in reversed(keys.values())]


def _stored_times(choice: Choice, scenes: Scenes, timing: Timing, store: Store) -> Times:
    """The times of a choice that the store has."""
    key = _times_key(choice, scenes, timing)
    stored = store.read("times", key)
    rounds = [stored[str(turn)] for turn in range(timing.rounds) if str(turn) in stored]
    return Times(
        milliseconds=tuple(spent for spent, _ in rounds),
        ratios=tuple(spent / reference for spent, reference in rounds if reference),
        memory=stored.get("memory"),
        clock=key["clock"],
        hardware=key["hardware"],
    )


def _times_key(choice: Choice, scenes: Scenes, timing: Timing) -> dict[str, Any]:
    used = min(len(scenes), timing.rounds - 1 + choice.batch)
    return {
        "choice": dict(choice.identity),
        "scenes": list(scenes.digests[:used]),
        "frames": timing.frames,
        "batch": choice.batch,
        "threads": choice.threads,
        "clock": clock_for(choice.device, choice.threads)[0],
        "hardware": describe_device(choice.device),
        "torch": torch.__version__,
    }


def _time_round(runner: _Runner, scenes: Scenes, turn: int, timing: Timing, warm_up: bool) -> float | None:
    """Milliseconds per computed frame and scene; None where the choice fails, which is stored.

    Where the machine fails the error is raised, so that the round is repeated the next time.
    """
    choice = runner.choice
    indices = [(turn + offset) % len(scenes) for offset in range(choice.batch)]
    frames = min(timing.frames, *(min(scenes.moving_frames(i), scenes.frames(i)) for i in indices))
    before = torch.get_num_threads()
    torch.set_num_threads(choice.threads)
    try:
        run = choice.prepare(scenes, indices)
        if warm_up:
            run(min(frames, _WARM_UP))
        if "memory" not in runner.stored:
            memory = peak_bytes(lambda: run(frames), choice.device)
            runner.stored["memory"] = memory if memory == memory else None  # (NaN is no JSON)
        _, clock = clock_for(choice.device, choice.threads)
        start = clock()
        run(frames)
        return 1e3 * (clock() - start) / (choice.computed_frames(frames) * choice.batch)
    except NmpmError as error:
        if is_machine_failure(error):
            raise
        runner.stored["failed"] = str(error)
        return None
    finally:
        torch.set_num_threads(before)
