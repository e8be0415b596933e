"""Poison: one number that is none must be named where it comes in, and never spread."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from torch import Tensor

from nmpm.data.format import Trajectory
from nmpm.emulator.rollouts import rollout
from nmpm.errors import DataError
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject

_GROUP = "poison"
_BAD = (math.nan, math.inf, -math.inf)


def poison(subject: Subject, size: Size) -> Iterator[Line]:  # noqa: ARG001 (every test of the battery is asked so)
    """NaN and infinity in a particle, a frame, a weight, a statistic."""
    yield _refused("a position that is no number", partial(_particle, subject, "position"))
    yield _refused("a velocity that is no number", partial(_particle, subject, "velocity"))
    yield _refused("a frame of a trajectory with what is no number", partial(_frame, subject))
    if any(True for _ in subject.emulator.processor.parameters()):
        yield _refused("a weight that is no number", partial(_weight, subject))
    yield _refused("a statistic that is no number", partial(_statistic, subject))


def _refused(name: str, attempt: Callable[[float], object]) -> Line:
    passed = 0
    for bad in _BAD:
        try:
            attempt(bad)
        except DataError:
            passed += 1
    return Line(_GROUP, name, passed == len(_BAD), {"refused": passed, "of": len(_BAD)}, "refused by name")


def _particle(subject: Subject, what: str, bad: float) -> object:
    state = subject.starts(1)
    values = getattr(state, what).clone()
    values[0, 0, 0] = bad
    return rollout(subject.emulator, dataclasses.replace(state, **{what: values}), 1)


def _frame(subject: Subject, bad: float) -> object:
    position = np.full((4, 2, subject.emulator.scene.dim), 0.5, np.float32)
    position[2, 1, 0] = bad
    return Trajectory(position, np.zeros(2, np.int64))


def _weight(subject: Subject, bad: float) -> object:
    return _spoilt(subject, lambda emulator: next(iter(emulator.processor.parameters())), bad)


def _statistic(subject: Subject, bad: float) -> object:
    return _spoilt(subject, lambda emulator: emulator.output_scale, bad)


def _spoilt(subject: Subject, choose: Callable[..., Tensor], bad: float) -> object:
    emulator = copy.deepcopy(subject.emulator)
    values = choose(emulator).data
    values[(0,) * values.dim()] = bad
    return rollout(emulator, subject.starts(1), 1)
