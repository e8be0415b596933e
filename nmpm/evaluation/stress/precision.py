"""Precision and sensitivity: deviations by rounding and by a nudge of 10⁻⁶; gradients of long unrolls."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from nmpm.data.simulation import try_seeds
from nmpm.emulator.model import Emulator
from nmpm.emulator.rollouts import rollout, unroll
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject
from nmpm.evaluation.stress.trace import INVARIANTS, rms_distance, trace_bundles
from nmpm.particles import Particles
from nmpm.sim import Preset

NUDGE = 1e-6
"""Of the domain's longest side: standard deviation of a nudge to the initial positions."""

_GROUP = "precision and sensitivity"


def precision(subject: Subject, size: Size) -> Iterator[Line]:
    """Rollouts in other precisions, beside the model's own sensitivity."""
    state, frames = subject.starts(size.scenes), 4 * subject.horizon
    emulator = subject.emulator.with_runtime("eager")  # which has every precision, and gradients
    plain = rollout(emulator, state, frames)
    nudged = rollout(emulator, nudge(subject, state), frames)
    double = rollout(copy.deepcopy(emulator).double(), state.double(), frames)
    own = rms_distance(emulator.grid, state.mask, plain, nudged)
    rounding = rms_distance(emulator.grid, state.mask, plain, double.to(plain.dtype))
    yield Line(
        _GROUP, "float32 beside float64", bool(rounding[-1] <= 10 * own[-1]), _at(subject, rounding, own),
        "no further apart than ten nudges of a millionth of the domain",
    )  # fmt: skip
    for dtype in (torch.bfloat16, torch.float16):
        with torch.autocast(state.position.device.type, dtype):
            half = rollout(emulator, state, frames)
        trace = trace_bundles(emulator, state, [half])
        figures = _at(subject, rms_distance(emulator.grid, state.mask, plain, half), own) | trace.figures()
        name = f"{str(dtype).removeprefix('torch.')} network beside float32"
        yield Line(_GROUP, name, trace.valid, figures, INVARIANTS)


def sensitivity(subject: Subject, size: Size) -> Iterator[Line]:
    """How fast a nudge grows, in the emulator and in the simulator; gradients through more and more bundles."""
    state, frames = subject.starts(size.scenes), 4 * subject.horizon
    emulator = subject.emulator.with_runtime("eager")
    pair = rollout(emulator, state, frames), rollout(emulator, nudge(subject, state), frames)
    figures = {"growth_per_100_frames": growth(rms_distance(emulator.grid, state.mask, *pair))}
    if subject.preset is not None:
        figures["simulator_growth_per_100_frames"] = _simulator_growth(subject, subject.preset, frames, size)
    yield Line(_GROUP, "growth of a nudge (exponent)", None, figures)
    norms = _gradients(emulator, state.scenes(slice(1)), size.bundles)
    yield Line(
        _GROUP, "gradients through unrolled bundles", all(math.isfinite(norm) for norm in norms.values()),
        {f"norm_K{bundles}": norm for bundles, norm in norms.items()}, "finite",
    )  # fmt: skip


def nudge(subject: Subject, state: Particles) -> Particles:
    """The state with every position nudged, the velocities left."""
    generator = torch.Generator().manual_seed(subject.seed)
    side = max(high - low for low, high in subject.emulator.scene.domain)
    noise = torch.randn(state.position.shape, generator=generator).to(state.position)
    low, high = state.position.new_tensor(subject.emulator.scene.bounds).T
    return state.with_motion((state.position + NUDGE * side * noise).clamp(low, high), state.velocity)


def growth(distance: Tensor) -> float:
    """Slope of the logarithm of a (T,) distance, per 100 frames: an estimate of the largest Lyapunov exponent."""
    frames = torch.arange(len(distance), dtype=torch.float64)
    logs = distance.double().clamp(min=1e-30).log()
    centred = frames - frames.mean()
    return 100 * float((centred * logs).sum() / centred.square().sum())


def _simulator_growth(subject: Subject, preset: Preset, frames: int, size: Size) -> float:
    rng = np.random.default_rng(subject.seed)
    side = max(high - low for low, high in preset.domain)

    def slope(seed: int) -> float:
        start = preset.draw(seed)
        noise = NUDGE * side * rng.standard_normal(start.position.shape)
        pair = start, dataclasses.replace(start, position=start.position + noise)
        runs = [preset.simulate_from(state, frames).position[1:] for state in pair]
        distance = np.sqrt(np.square(runs[0] - runs[1]).sum(-1).mean(-1))
        return growth(torch.from_numpy(distance))

    slopes = [try_seeds(entropy, slope) for entropy in subject.entropies(size.scenes)]
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


def _at(subject: Subject, distance: Tensor, own: Tensor) -> dict[str, float]:
    first, last = subject.horizon, len(distance)
    return {
        f"apart_cells_at_{first}": float(distance[first - 1]),
        f"apart_cells_at_{last}": float(distance[-1]),
        f"nudged_cells_at_{last}": float(own[-1]),
    }
