"""Long rollouts: a hundred training horizons and more, energy, rest, volume."""

from __future__ import annotations

import statistics
from collections.abc import Iterator

import torch
from torch import Tensor

from nmpm.evaluation.stress.course import SOUND, Course, filled, run
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject, simulated
from nmpm.particles import Particles

MOST_DRIFT = 0.1
"""Cells per 1000 frames, root mean square: what still counts as rest."""

MOST_LOST = 0.01
"""Share of its volume that settled material may lose."""

_GROUP = "long"
_PROBE = 200
"""Frames at the end of the simulation, for the simulator's own drift."""


def duration(subject: Subject, size: Size) -> Iterator[Line]:
    """Long rollouts of the scenes that the model knows."""
    state = subject.starts(size.scenes)
    frames = size.horizons * subject.horizon
    long = run(subject.emulator, state, frames)
    curves = {"energy, % above the start": (_thinned(100 * long.gain.amax(0)), frames)}
    yield Line(
        _GROUP, f"{size.horizons} training horizons ({frames} frames)", long.sound, long.figures(), SOUND, curves
    )  # fmt: skip
    yield failure(long)
    far = run(subject.emulator, state.scenes(slice(1)), size.far)
    yield Line(_GROUP, f"{size.far:,} frames", far.sound, far.figures(), SOUND)
    yield from settled(subject, long, state, size)


def failure(course: Course) -> Line:
    """The first frames at which an invariant breaks."""
    steps = course.steps_to_failure()
    figures = {"least": min(steps), "median": statistics.median(steps), "most": max(steps), "of": course.frames}
    return Line(_GROUP, "steps to failure (one more than all: none)", None, {k: float(v) for k, v in figures.items()})


def settled(subject: Subject, course: Course, state: Particles, size: Size) -> Iterator[Line]:
    """What has come to rest, in the simulator where there is one, stays there and keeps its volume."""
    before, figures = {}, {}
    if subject.simulator is not None:
        window = simulated(subject.simulator, subject.seeds(size.scenes), size.settling * subject.simulator.frames)
        state, last = window.initial, window.target[:, -1]
        probe = min(_PROBE, window.target.shape[1] - 1)
        earlier = window.target[:, -probe - 1]
        figures = {"simulator_drift": _drift(subject, state, earlier, last, probe)}
        before = {"simulator_change_percent": _change(subject, state, earlier, last)}
    else:
        last = course.last
    rest = state.moved(last, torch.zeros_like(last))
    own = filled(subject.emulator, rest, rest.position).unsqueeze(1)
    long = run(subject.emulator, rest, size.settled, every=max(1, size.settled // 20))
    ratio = long.filled / own - 1
    change = float(ratio.abs().max())
    yield Line(
        _GROUP, f"volume of settled material, {size.settled:,} frames", change <= MOST_LOST,
        {"change_percent": 100 * change} | before, f"filled volume within {MOST_LOST:.0%}",
        {"filled volume, % change": (_thinned(100 * ratio.mean(0)), size.settled)},
    )  # fmt: skip
    drift = _drift(subject, rest, rest.position, long.last, size.settled)
    yield Line(
        _GROUP, "rest stays at rest", drift <= MOST_DRIFT, {"drift": drift} | figures,
        f"drift under {MOST_DRIFT} cells per 1000 frames, root mean square",
    )  # fmt: skip


def _drift(subject: Subject, state: Particles, one: Tensor, other: Tensor, frames: int) -> float:
    """Root mean square of the way from (B, N, D) to (B, N, D), in cells per 1000 frames."""
    cells = (other - one) / one.new_tensor(subject.emulator.grid.spacing)
    return float(cells[state.mask].square().sum(-1).mean().sqrt()) * 1000 / frames


def _change(subject: Subject, state: Particles, one: Tensor, other: Tensor) -> float:
    """The most that a scene's filled volume differs between (B, N, D) and (B, N, D), in percent."""
    volumes = [filled(subject.emulator, state, position) for position in (one, other)]
    return 100 * float((volumes[1] / volumes[0] - 1).abs().max())


def _thinned(values: Tensor) -> list[float]:
    """Evenly spaced ones of (T,) values, fewer than 800."""
    kept: list[float] = values[:: max(1, len(values) // 400)].tolist()
    return kept
