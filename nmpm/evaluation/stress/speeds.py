"""Fast and slow: other initial speeds, other gravity."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from nmpm.emulator.rollouts import rollout
from nmpm.evaluation.stress.course import SOUND, Course, follow
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject, simulated
from nmpm.particles import Window
from nmpm.sim import MpmPreset

SPEEDS = (0.0, 1e-3, 1.0, 3.0, 10.0)
GRAVITIES = (0.0, 0.5, 2.0, -1.0)

_GROUP = "fast and slow"


def speeds(subject: Subject, size: Size) -> Iterator[Line]:
    """Initial speeds and gravity times a factor, beside the simulator where there is one."""
    for factor in SPEEDS:
        yield _line(subject, f"initial speed × {factor:g}", _faster(subject, factor, size))
    for factor in GRAVITIES:
        yield _line(subject, f"gravity × {factor:g}", _heavier(subject, factor, size))


def judged(subject: Subject, window: Window) -> tuple[Course, dict[str, float]]:
    """A rollout of a window's scenes, and its figures: MSE against the simulator where the window holds its frames.

    The MSE, in length², stands beside that of nothing moving.
    """
    frames = window.target.shape[1]
    predicted = rollout(subject.emulator, window.initial, max(frames, subject.horizon))
    course = follow(subject.emulator, window.initial, [predicted])
    if not frames:
        return course, course.figures()
    squared = (predicted[:, :frames] - window.target).square().mean(-1)
    still = (window.initial.position.unsqueeze(1) - window.target).square().mean(-1)
    real = window.mask.unsqueeze(1).expand_as(squared)
    errors = {"mse": float(squared[real].mean()), "mse_nothing_moves": float(still[real].mean())}
    return course, course.figures() | errors


def _line(subject: Subject, name: str, window: Window) -> Line:
    course, figures = judged(subject, window)
    return Line(_GROUP, name, course.sound, figures, SOUND)


def _faster(subject: Subject, factor: float, size: Size) -> Window:
    preset = subject.simulator
    if preset is not None:
        blocks = dataclasses.replace(preset.blocks, speed=factor * preset.blocks.speed)
        return simulated(dataclasses.replace(preset, blocks=blocks), subject.seeds(size.scenes), size.compared)
    state = subject.starts(size.scenes)
    return Window.of(state.moved(state.position, factor * state.velocity))


def _heavier(subject: Subject, factor: float, size: Size) -> Window:
    preset = subject.simulator
    if preset is not None:
        return simulated(_weighed(preset, factor), subject.seeds(size.scenes), size.compared)
    state = subject.starts(size.scenes)
    return Window.of(dataclasses.replace(state, gravity=factor * state.gravity))


def _weighed(preset: MpmPreset, factor: float) -> MpmPreset:
    return dataclasses.replace(preset, gravity=tuple(factor * g for g in preset.gravity))
