"""Measure a sweep: errors of every choice, then times of all in turn."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from nmpm.evaluation.trade.accuracy import measure_accuracy
from nmpm.evaluation.trade.choice import Choice
from nmpm.evaluation.trade.points import Point, collect_points
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.store import Store
from nmpm.evaluation.trade.sweep import Sweep
from nmpm.evaluation.trade.timing import measure_times

Progress = Callable[[str], object]
"""Called after each scene of a choice and each timed rollout, with what was done."""


def count_steps(choices: Sequence[Choice], scenes: Scenes, sweep: Sweep) -> int:
    """How often `measure` calls its progress."""
    return len(choices) * (len(scenes) + sweep.timing.rounds)


def measure(choices: Sequence[Choice], scenes: Scenes, sweep: Sweep, store: Store, progress: Progress) -> list[Point]:
    """The points of all choices; what the store knows is not measured again.

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
    for _ in measure_times(choices, choices[0], scenes, sweep.timing, store):
        progress("times, all choices in turn")
    return collect_points(choices, scenes, sweep.measures, sweep.timing, store)
