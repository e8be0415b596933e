"""Precision, sensitivity to a nudge of 10⁻⁶, gradients of long unrolls, and rejection of non-finite inputs by name."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor

from nmpm.data.format import Trajectory
from nmpm.data.simulation import try_seeds
from nmpm.emulator.model import Emulator
from nmpm.emulator.rollouts import rollout, unroll
from nmpm.errors import DataError
from nmpm.evaluation.stress.model import ModelUnderTest
from nmpm.evaluation.stress.results import Effort, TestResult
from nmpm.evaluation.stress.trace import INVARIANTS, rms_distance, trace_bundles
from nmpm.particles import Particles
from nmpm.sim import Preset

NUDGE = 1e-6
"""Of the domain's longest side: standard deviation of a nudge to the initial positions."""

NON_FINITE = (math.nan, math.inf, -math.inf)

_PRECISION = "precision and sensitivity"


def precision(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """Rollouts in other precisions, beside the model's own sensitivity."""
    state, frames = model.starts(effort.scenes), 4 * model.horizon
    emulator = model.emulator.with_runtime("eager")  # which has every precision, and gradients
    plain = rollout(emulator, state, frames)
    nudged = rollout(emulator, nudge_positions(model, state), frames)
    double = rollout(copy.deepcopy(emulator).double(), state.double(), frames)
    nudge_distance = rms_distance(emulator.grid, state.mask, plain, nudged)
    rounding = rms_distance(emulator.grid, state.mask, plain, double.to(plain.dtype))
    yield TestResult(
        _PRECISION, "float32 beside float64", bool(rounding[-1] <= 10 * nudge_distance[-1]),
        _at(model, rounding, nudge_distance),
        "no further apart than ten nudges of a millionth of the domain",
    )  # fmt: skip
    for dtype in (torch.bfloat16, torch.float16):
        with torch.autocast(state.position.device.type, dtype):
            half = rollout(emulator, state, frames)
        trace = trace_bundles(emulator, state, [half])
        figures = _at(model, rms_distance(emulator.grid, state.mask, plain, half), nudge_distance) | trace.figures()
        name = f"{str(dtype).removeprefix('torch.')} network beside float32"
        yield TestResult(_PRECISION, name, trace.valid, figures, INVARIANTS)


def sensitivity(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """How fast a nudge grows, in the emulator and in the simulator; gradients through more and more bundles."""
    state, frames = model.starts(effort.scenes), 4 * model.horizon
    emulator = model.emulator.with_runtime("eager")
    pair = rollout(emulator, state, frames), rollout(emulator, nudge_positions(model, state), frames)
    figures = {"growth_per_100_frames": growth(rms_distance(emulator.grid, state.mask, *pair))}
    if model.preset is not None:
        figures["simulator_growth_per_100_frames"] = _simulator_growth(model, model.preset, frames, effort)
    yield TestResult(_PRECISION, "growth of a nudge (exponent)", None, figures)
    norms = _gradients(emulator, state.scenes(slice(1)), effort.bundles)
    yield TestResult(
        _PRECISION, "gradients through unrolled bundles", all(math.isfinite(norm) for norm in norms.values()),
        {f"norm_K{bundles}": norm for bundles, norm in norms.items()}, "finite",
    )  # fmt: skip


def nudge_positions(model: ModelUnderTest, state: Particles) -> Particles:
    """The state with every position nudged, the velocities left."""
    generator = torch.Generator().manual_seed(model.seed)
    side = max(high - low for low, high in model.emulator.scene.domain)
    noise = torch.randn(state.position.shape, generator=generator).to(state.position)
    low, high = state.position.new_tensor(model.emulator.scene.bounds).T
    return state.with_motion((state.position + NUDGE * side * noise).clamp(low, high), state.velocity)


def growth(distance: Tensor) -> float:
    """Slope of the logarithm of a (T,) distance, per 100 frames: an estimate of the largest Lyapunov exponent."""
    frames = torch.arange(len(distance), dtype=torch.float64)
    logs = distance.double().clamp(min=1e-30).log()
    centred = frames - frames.mean()
    return 100 * float((centred * logs).sum() / centred.square().sum())


def _simulator_growth(model: ModelUnderTest, preset: Preset, frames: int, effort: Effort) -> float:
    rng = np.random.default_rng(model.seed)
    side = max(high - low for low, high in preset.domain)

    def slope(seed: int) -> float:
        start = preset.draw(seed)
        noise = NUDGE * side * rng.standard_normal(start.position.shape)
        pair = start, dataclasses.replace(start, position=start.position + noise)
        runs = [preset.simulate_from(state, frames).position[1:] for state in pair]
        distance = np.sqrt(np.square(runs[0] - runs[1]).sum(-1).mean(-1))
        return growth(torch.from_numpy(distance))

    slopes = [try_seeds(entropy, slope) for entropy in model.entropies(effort.scenes)]
    return float(np.mean(slopes))


def _gradients(emulator: Emulator, state: Particles, most: int) -> dict[int, float]:
    """Norm of the gradient of the final mean position with respect to the initial velocities, for K = 1, 2, 4, …"""
    norms = {}
    for bundles in (2**power for power in range(most.bit_length()) if 2**power <= most):
        velocity = state.velocity.clone().requires_grad_()
        with torch.enable_grad():
            *_, last = unroll(emulator, state.with_motion(state.position, velocity), bundles)
            (gradient,) = torch.autograd.grad(last.position[:, -1].mean(), velocity)
        norms[bundles] = float(gradient.norm())
    return norms


def _at(model: ModelUnderTest, distance: Tensor, nudged: Tensor) -> dict[str, float]:
    first, last = model.horizon, len(distance)
    return {
        f"apart_cells_at_{first}": float(distance[first - 1]),
        f"apart_cells_at_{last}": float(distance[-1]),
        f"nudged_cells_at_{last}": float(nudged[-1]),
    }


def poison(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:  # noqa: ARG001 (all groups share a signature)
    """NaN and infinity in a particle, a frame, a weight, a statistic."""
    emulator, state = model.emulator, model.starts(1)

    def run_particles(what: str, bad: float) -> None:
        values = getattr(state, what).clone()
        values[0, 0, 0] = bad
        rollout(emulator, dataclasses.replace(state, **{what: values}), 1)

    def make_trajectory(bad: float) -> None:
        position = np.full((4, 2, emulator.scene.dim), 0.5, np.float32)
        position[2, 1, 0] = bad
        Trajectory(position, np.zeros(2, np.int64))

    def run_emulator(choose: Callable[[Emulator], Tensor], bad: float) -> None:
        changed = copy.deepcopy(emulator)
        values = choose(changed).data
        values[(0,) * values.dim()] = bad
        rollout(changed, state, 1)

    attempts: dict[str, Callable[[float], None]] = {
        "a position": partial(run_particles, "position"),
        "a velocity": partial(run_particles, "velocity"),
        "a trajectory with a frame": make_trajectory,
        "a weight": partial(run_emulator, lambda changed: next(changed.processor.parameters())),
        "a statistic": partial(run_emulator, lambda changed: changed.output_scale),
    }
    if not any(True for _ in emulator.processor.parameters()):
        del attempts["a weight"]
    for name, attempt in attempts.items():
        refused = 0
        for bad in NON_FINITE:
            try:
                attempt(bad)
            except DataError:
                refused += 1
        yield TestResult(
            "poison", f"{name} that is not finite", refused == len(NON_FINITE),
            {"refused": refused, "of": len(NON_FINITE)}, "rejected by name",
        )  # fmt: skip
