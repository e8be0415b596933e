"""Long rollouts: energy over a hundred training horizons and more; rest, volume and shape of settled material."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from nmpm.emulator import Emulator, stream_rollout
from nmpm.evaluation.stress.model import ModelUnderTest, simulate_beside, simulate_window
from nmpm.evaluation.stress.results import Effort, TestResult
from nmpm.evaluation.stress.trace import INVARIANTS, Trace, filled_volume, trace_rollout
from nmpm.metrics.quantities import measure_shape
from nmpm.particles import Particles
from nmpm.sim.preset import twin_of

MAX_DRIFT = 0.1
"""Cells per 1000 frames, root mean square: what still counts as rest."""

MAX_VOLUME_CHANGE = 0.01
"""Share by which the volume of settled material may change."""

PROBE = 200
"""Frames at the end of the simulation, for the simulator's own drift."""

MAX_DEVIATION = 0.05
"""Share by which height, occupied cells and crowding may differ from the simulator's."""

_LONG, _SETTLING = "long", "settling"
_NEEDS = f"height, occupied cells and crowding within {MAX_DEVIATION:.0%} of the simulator's"


def duration(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """Long rollouts of the scenes that the model knows."""
    yield from energy_and_rest(model, effort)
    far = trace_rollout(model.emulator, model.starts(1), effort.far)
    yield TestResult(_LONG, f"{effort.far:,} frames", far.valid, far.figures(), INVARIANTS)


def energy_and_rest(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """Energy over many training horizons, then rest and volume of what has settled."""
    state = model.starts(effort.scenes)
    frames = effort.horizons * model.horizon
    long = trace_rollout(model.emulator, state, frames)
    curves = {"energy, % above the start": (_subsample(100 * long.gain.amax(0)), frames)}
    yield TestResult(
        _LONG, f"{effort.horizons} training horizons ({frames} frames)", long.valid, long.figures(), INVARIANTS, curves
    )  # fmt: skip
    steps = long.steps_to_failure()
    figures = {"least": min(steps), "median": statistics.median(steps), "most": max(steps), "of": frames}
    yield TestResult(_LONG, "steps to failure (one more than all: none)", None, figures)
    yield from _settled_results(model, long, state, effort)


def _settled_results(model: ModelUnderTest, trace: Trace, state: Particles, effort: Effort) -> Iterator[TestResult]:
    """Material that has settled, in the simulator where there is one, stays where it is and keeps its volume.

    The rest constraint alone can make these tests pass; `settling` tests how material comes to rest.
    """
    before, figures = {}, {}
    if model.preset is not None:
        window = simulate_window(model, model.preset, effort.scenes, effort.settling * model.preset.frames)
        state, last = window.initial, window.target[:, -1]
        probe = min(PROBE, window.target.shape[1] - 1)
        earlier = window.target[:, -probe - 1]
        figures = {"simulator_drift": _drift(model, state, earlier, last, probe)}
        before = {"simulator_change_percent": _change(model, state, earlier, last)}
    else:
        last = trace.last
    rest = state.with_motion(last, torch.zeros_like(last))
    initial = filled_volume(model.emulator, rest, rest.position).unsqueeze(1)
    long = trace_rollout(model.emulator, rest, effort.settled, every=max(1, effort.settled // 20))
    ratio = long.filled / initial - 1
    change = float(ratio.abs().max())
    yield TestResult(
        _LONG, f"volume of settled material, {effort.settled:,} frames", change <= MAX_VOLUME_CHANGE,
        {"change_percent": 100 * change} | before, f"filled volume within {MAX_VOLUME_CHANGE:.0%}",
        {"filled volume, % change": (_subsample(100 * ratio.mean(0)), effort.settled)},
    )  # fmt: skip
    drift = _drift(model, rest, rest.position, long.last, effort.settled)
    yield TestResult(
        _LONG, "rest stays at rest", drift <= MAX_DRIFT, {"drift": drift} | figures,
        f"drift under {MAX_DRIFT} cells per 1000 frames, root mean square",
    )  # fmt: skip


def _drift(model: ModelUnderTest, state: Particles, one: Tensor, other: Tensor, frames: int) -> float:
    """Root mean square displacement between positions (B, N, D) of two frames, in cells per 1000 frames."""
    cells = (other - one) / one.new_tensor(model.emulator.grid.spacing)
    return float(cells[state.mask].square().sum(-1).mean().sqrt()) * 1000 / frames


def _change(model: ModelUnderTest, state: Particles, one: Tensor, other: Tensor) -> float:
    """Largest difference of a scene's filled volume between positions (B, N, D) of two frames, in percent."""
    volumes = [filled_volume(model.emulator, state, position) for position in (one, other)]
    return 100 * float((volumes[1] / volumes[0] - 1).abs().max())


def _subsample(values: Tensor) -> list[float]:
    """At most 800 evenly spaced ones of (T,) values."""
    kept: list[float] = values[:: max(1, len(values) // 400)].tolist()
    return kept


def settling(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """Shape beside the simulator's at the same frames, with constraints and without.

    Constraints freeze particles that hardly move, so that a test of resting material alone would test them, not the
    network. Each figure is reported beside that of the simulator's twin, which shows the simulator's own scatter.
    """
    preset = model.preset
    if preset is None or not model.emulator.scene.gravity_known:
        yield TestResult(_SETTLING, "shape beside the simulator: there is none, or gravity is unknown", None, {})
        return
    forms = {"with constraints": model.emulator, "without constraints": model.emulator.unconstrained()}
    if forms["with constraints"].constraints == forms["without constraints"].constraints:
        del forms["with constraints"]
    frames = [round(multiple * preset.frames) for multiple in effort.settling_multiples]
    totals: dict[str, dict[str, float]] = {name: {} for name in ("simulator", "twin", *forms)}
    for truth, twin in simulate_beside(model, preset, effort.settling_scenes, max(frames), [twin_of(preset)]):
        paths = {"simulator": truth.target[:, [frame - 1 for frame in frames]]}
        paths["twin"] = twin.target[:, [frame - 1 for frame in frames]]
        paths |= {name: _predict_frames(emulator, truth.initial, frames) for name, emulator in forms.items()}
        for name, path in paths.items():
            for frame, position in zip(frames, path.unbind(1), strict=True):
                shape = measure_shape(model.emulator.scene, model.emulator.grid, truth.initial, position)
                for what, value in shape.items():
                    key = f"{what}_at_{frame}"
                    totals[name][key] = totals[name].get(key, 0.0) + float(value)
    simulated = totals.pop("simulator")
    ratios = {name: {key: total / simulated[key] for key, total in sums.items()} for name, sums in totals.items()}
    beside = {f"twin_{key}": value for key, value in ratios["twin"].items()}
    for name in forms:
        worst = max(abs(value - 1) for value in ratios[name].values())
        title = f"shape beside the simulator, {name}"
        yield TestResult(_SETTLING, title, worst <= MAX_DEVIATION, ratios[name] | beside, _NEEDS)


def _predict_frames(emulator: Emulator, state: Particles, frames: Sequence[int]) -> Tensor:
    """Positions (B, F, N, D) of a rollout at frames, which count from 1; only one bundle is kept at a time."""
    kept, made = [], 0
    for part in stream_rollout(emulator, state, max(frames)):
        ahead = part.position.shape[1]
        kept += [part.position[:, frame - made - 1] for frame in frames if made < frame <= made + ahead]
        made += ahead
    return torch.stack(kept, dim=1)
