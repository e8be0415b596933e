"""Fast and slow: other initial speeds, other gravity."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import suppress

from nmpm.emulator import rollout
from nmpm.errors import UnstableError
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject, simulate_window
from nmpm.evaluation.stress.trace import INVARIANTS, Trace, trace_bundles
from nmpm.particles import Window

SPEEDS = (0.0, 1e-3, 1.0, 3.0, 10.0)
GRAVITIES = (0.0, 0.5, 2.0, -1.0)

_GROUP = "fast and slow"


def speeds(subject: Subject, size: Size) -> Iterator[Line]:
    """Initial speeds and gravity times a factor, beside the simulator where there is one that stays stable."""
    for factor in SPEEDS:
        yield _line(subject, f"initial speed × {factor:g}", _changed_window(subject, size, speed=factor))
    for factor in GRAVITIES:
        yield _line(subject, f"gravity × {factor:g}", _changed_window(subject, size, gravity=factor))


def compare_window(subject: Subject, window: Window) -> tuple[Trace, dict[str, float]]:
    """A rollout of a window's scenes and its figures, with the MSE where the window holds frames to predict.

    The MSE, in length², stands beside that of nothing moving.
    """
    frames = window.target.shape[1]
    predicted = rollout(subject.emulator, window.initial, max(frames, subject.horizon))
    trace = trace_bundles(subject.emulator, window.initial, [predicted])
    if not frames:
        return trace, trace.figures()
    squared = (predicted[:, :frames] - window.target).square().mean(-1)
    still = (window.initial.position.unsqueeze(1) - window.target).square().mean(-1)
    real = window.mask.unsqueeze(1).expand_as(squared)
    errors = {"mse": float(squared[real].mean()), "mse_nothing_moves": float(still[real].mean())}
    return trace, trace.figures() | errors


def _line(subject: Subject, name: str, window: Window) -> Line:
    trace, figures = compare_window(subject, window)
    return Line(_GROUP, name, trace.valid, figures, INVARIANTS)


def _changed_window(subject: Subject, size: Size, *, speed: float = 1.0, gravity: float = 1.0) -> Window:
    """Scenes with initial speeds and gravity times a factor: simulated, or two frames and nothing to compare with."""
    if subject.preset is not None:
        with suppress(UnstableError):
            changed = subject.preset.varied(speed=speed, gravity=gravity)
            return simulate_window(subject, changed, size.scenes, size.compared)
    state = subject.starts(size.scenes)
    return Window.of(dataclasses.replace(state, velocity=speed * state.velocity, gravity=gravity * state.gravity))
