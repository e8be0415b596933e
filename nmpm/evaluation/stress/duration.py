"""Long rollouts: energy over a hundred training horizons and more; rest and volume of settled material."""

from __future__ import annotations

import statistics
from collections.abc import Iterator

import torch
from torch import Tensor

from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject, simulate_window
from nmpm.evaluation.stress.trace import INVARIANTS, Trace, filled_volume, trace_rollout
from nmpm.particles import Particles

MAX_DRIFT = 0.1
"""Cells per 1000 frames, root mean square: what still counts as rest."""

MAX_VOLUME_CHANGE = 0.01
"""Share by which the volume of settled material may change."""

_GROUP = "long"
_PROBE = 200
"""Frames at the end of the simulation, for the simulator's own drift."""


def duration(subject: Subject, size: Size) -> Iterator[Line]:
    """Long rollouts of the scenes that the model knows."""
    yield from energy_and_rest(subject, size)
    far = trace_rollout(subject.emulator, subject.starts(1), size.far)
    yield Line(_GROUP, f"{size.far:,} frames", far.valid, far.figures(), INVARIANTS)


def energy_and_rest(subject: Subject, size: Size) -> Iterator[Line]:
    """Energy over many training horizons, then rest and volume of what has settled."""
    state = subject.starts(size.scenes)
    frames = size.horizons * subject.horizon
    long = trace_rollout(subject.emulator, state, frames)
    curves = {"energy, % above the start": (_subsample(100 * long.gain.amax(0)), frames)}
    yield Line(
        _GROUP, f"{size.horizons} training horizons ({frames} frames)", long.valid, long.figures(), INVARIANTS, curves
    )  # fmt: skip
    yield failure(long)
    yield from settled_lines(subject, long, state, size)


def failure(trace: Trace) -> Line:
    """The first frames at which an invariant breaks."""
    steps = trace.steps_to_failure()
    figures = {"least": min(steps), "median": statistics.median(steps), "most": max(steps), "of": trace.frames}
    return Line(_GROUP, "steps to failure (one more than all: none)", None, {k: float(v) for k, v in figures.items()})


def settled_lines(subject: Subject, trace: Trace, state: Particles, size: Size) -> Iterator[Line]:
    """Material that has settled, in the simulator where there is one, stays where it is and keeps its volume.

    The rest constraint alone can make these lines pass; `settling` tests how material comes to rest.
    """
    before, figures = {}, {}
    if subject.preset is not None:
        window = simulate_window(subject, subject.preset, size.scenes, size.settling * subject.preset.frames)
        state, last = window.initial, window.target[:, -1]
        probe = min(_PROBE, window.target.shape[1] - 1)
        earlier = window.target[:, -probe - 1]
        figures = {"simulator_drift": _drift(subject, state, earlier, last, probe)}
        before = {"simulator_change_percent": _change(subject, state, earlier, last)}
    else:
        last = trace.last
    rest = state.with_motion(last, torch.zeros_like(last))
    own = filled_volume(subject.emulator, rest, rest.position).unsqueeze(1)
    long = trace_rollout(subject.emulator, rest, size.settled, every=max(1, size.settled // 20))
    ratio = long.filled / own - 1
    change = float(ratio.abs().max())
    yield Line(
        _GROUP, f"volume of settled material, {size.settled:,} frames", change <= MAX_VOLUME_CHANGE,
        {"change_percent": 100 * change} | before, f"filled volume within {MAX_VOLUME_CHANGE:.0%}",
        {"filled volume, % change": (_subsample(100 * ratio.mean(0)), size.settled)},
    )  # fmt: skip
    drift = _drift(subject, rest, rest.position, long.last, size.settled)
    yield Line(
        _GROUP, "rest stays at rest", drift <= MAX_DRIFT, {"drift": drift} | figures,
        f"drift under {MAX_DRIFT} cells per 1000 frames, root mean square",
    )  # fmt: skip


def _drift(subject: Subject, state: Particles, one: Tensor, other: Tensor, frames: int) -> float:
    """Root mean square displacement between positions (B, N, D) of two frames, in cells per 1000 frames."""
    cells = (other - one) / one.new_tensor(subject.emulator.grid.spacing)
    return float(cells[state.mask].square().sum(-1).mean().sqrt()) * 1000 / frames


def _change(subject: Subject, state: Particles, one: Tensor, other: Tensor) -> float:
    """Largest difference of a scene's filled volume between positions (B, N, D) of two frames, in percent."""
    volumes = [filled_volume(subject.emulator, state, position) for position in (one, other)]
    return 100 * float((volumes[1] / volumes[0] - 1).abs().max())


def _subsample(values: Tensor) -> list[float]:
    """At most 800 evenly spaced ones of (T,) values."""
    kept: list[float] = values[:: max(1, len(values) // 400)].tolist()
    return kept
