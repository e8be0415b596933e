"""Scenes unlike training's: other speeds, gravity, particle counts, densities, box sizes, grids and symmetries."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import suppress

import torch
from torch import Tensor

from nmpm.emulator.adaptation import adapted
from nmpm.emulator.calibration import with_usual_gravity
from nmpm.emulator.rollouts import rollout
from nmpm.errors import ConfigError, UnstableError
from nmpm.evaluation.stress.model import ModelUnderTest, simulate_window
from nmpm.evaluation.stress.results import Effort, TestResult
from nmpm.evaluation.stress.trace import INVARIANTS, Trace, rms_distance, trace_bundles, trace_rollout
from nmpm.particles import Particles, Window, lattice, state_at_rest, thrown_blocks

SPEEDS = (0.0, 1e-3, 1.0, 3.0, 10.0)
GRAVITIES = (0.0, 0.5, 2.0, -1.0)
VOLUME_SHARE = 0.1
"""Share of the box that the block of material fills, whatever its number of particles."""

_COUNTS, _SIZES = "many and few", "size and symmetry"


def speeds(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """Initial speeds and gravity times a factor, beside the simulator where there is one that stays stable."""
    changes = {f"initial speed × {factor:g}": (factor, 1.0) for factor in SPEEDS}
    changes |= {f"gravity × {factor:g}": (1.0, factor) for factor in GRAVITIES}
    for name, (speed, gravity) in changes.items():
        trace, figures = compare_window(model, _changed_window(model, effort, speed, gravity))
        yield TestResult("fast and slow", name, trace.valid, figures, INVARIANTS)


def compare_window(model: ModelUnderTest, window: Window) -> tuple[Trace, dict[str, float]]:
    """A rollout of a window's scenes and its figures, with the MSE where the window holds frames to predict.

    The MSE, in length², stands beside that of nothing moving.
    """
    frames = window.target.shape[1]
    predicted = rollout(model.emulator, window.initial, max(frames, model.horizon))
    trace = trace_bundles(model.emulator, window.initial, [predicted])
    if not frames:
        return trace, trace.figures()
    squared = (predicted[:, :frames] - window.target).square().mean(-1)
    still = (window.initial.position.unsqueeze(1) - window.target).square().mean(-1)
    real = window.mask.unsqueeze(1).expand_as(squared)
    errors = {"mse": float(squared[real].mean()), "mse_nothing_moves": float(still[real].mean())}
    return trace, trace.figures() | errors


def _changed_window(model: ModelUnderTest, effort: Effort, speed: float, gravity: float) -> Window:
    """Scenes with initial speeds and gravity times a factor: simulated, or two frames and nothing to compare with."""
    if model.preset is not None:
        with suppress(UnstableError):
            changed = model.preset.varied(speed=speed, gravity=gravity)
            return simulate_window(model, changed, effort.scenes, effort.compared)
    state = model.starts(effort.scenes)
    return Window.of(dataclasses.replace(state, velocity=speed * state.velocity, gravity=gravity * state.gravity))


def counts(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """The same block of material in fewer and in more particles, and other densities."""
    yield from _with_counts(model, effort)
    for factor in (0.5, 2.0):
        yield _with_density(model, factor, effort)
    yield _empty_box(model)
    yield _full_box(model, effort)


def _with_counts(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """The finest first, as the others' centres of mass are compared with its own."""
    volume, finest = VOLUME_SHARE * model.emulator.scene.volume, None
    for number in (10**power for power in reversed(range(8)) if 10**power <= effort.particles):
        scene = dataclasses.replace(model.emulator.scene, particle_volume=volume / number)
        state = with_usual_gravity(model.emulator, thrown_blocks(scene, count=number, seed=model.seed))
        state = state.to(model.device)
        trace = trace_rollout(model.emulator.over(scene), state, 2 * model.horizon)
        centre = trace.last.mean(1)
        finest = centre if finest is None else finest
        cells = (centre - finest) / centre.new_tensor(model.emulator.grid.spacing)
        figures = trace.figures() | {"centre_apart_cells": float(cells.norm())}
        name = f"{state.position.shape[1]:,} particles of the same volume"
        yield TestResult(_COUNTS, name, trace.valid, figures, INVARIANTS)


def _with_density(model: ModelUnderTest, factor: float, effort: Effort) -> TestResult:
    """Positions scaled around each scene's centre of mass: densities that training never showed."""
    scene, state = model.emulator.scene, model.starts(effort.scenes)
    real = state.mask.unsqueeze(-1)
    centre = (state.position * real).sum(1, keepdim=True) / real.sum(1, keepdim=True)
    low, high = state.position.new_tensor(scene.bounds).T
    position = (centre + (state.position - centre) * factor ** (-1 / scene.dim)).clamp(low, high)
    trace = trace_rollout(model.emulator.over(scene), state.with_motion(position, state.velocity), model.horizon)
    return TestResult(_COUNTS, f"density × {factor:g}", trace.valid, trace.figures(), INVARIANTS)


def _empty_box(model: ModelUnderTest) -> TestResult:
    """A state without particles."""
    state = model.starts(1)
    none = {name: getattr(state, name)[:, :0] for name in ("position", "velocity", "material", "mask")}
    predicted = rollout(model.emulator, dataclasses.replace(state, **none), model.horizon)
    passed = predicted.shape == (1, model.horizon, 0, predicted.shape[-1])
    return TestResult(_COUNTS, "no particle", passed, {}, "no error")


def _full_box(model: ModelUnderTest, effort: Effort) -> TestResult:
    """A box full of particles, which can hardly move; coarser ones where too many would be needed."""
    scene = model.emulator.scene
    scene = dataclasses.replace(scene, particle_volume=max(scene.particle_volume, scene.volume / effort.particles))
    state = state_at_rest(scene, lattice(scene.bounds, scene.particle_spacing))
    state = with_usual_gravity(model.emulator, state).to(model.device)
    trace = trace_rollout(model.emulator.over(scene), state, 4 * model.horizon)
    moved = rms_distance(model.emulator.grid, state.mask, state.position.unsqueeze(1), trace.last.unsqueeze(1))
    figures = trace.figures() | {"moved_cells": float(moved)}
    return TestResult(_COUNTS, f"a full box ({state.position.shape[1]:,} particles)", trace.valid, figures, INVARIANTS)


def sizes(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """Domains twice and four times as wide, cells half and twice as wide, and symmetries of the box."""
    for times in (2, 4):
        yield _wide(model, times, effort)
    for name, factor in (("refined", 2), ("coarsened", 0.5)):
        yield _with_cells(model, name, factor, effort)
    yield from _symmetries(model, effort)


def _wide(model: ModelUnderTest, times: int, effort: Effort) -> TestResult:
    name = f"domain {times} × as wide"
    if model.preset is not None:
        preset = model.preset.widened(times)
        window, scene = simulate_window(model, preset, effort.scenes, effort.compared), model.read(preset).scene
    else:
        window, scene = Window.of(model.starts(1)), model.emulator.scene
        longer = (times - 1) * (scene.domain[0][1] - scene.domain[0][0])
        (low, high), (first, last) = scene.bounds[0], scene.domain[0]
        bounds, domain = ((low, high + longer), *scene.bounds[1:]), ((first, last + longer), *scene.domain[1:])
        scene = dataclasses.replace(scene, bounds=bounds, domain=domain)
    try:
        wide = model.with_emulator(model.emulator.over(scene))
    except ConfigError as error:
        return TestResult(_SIZES, f"{name}: {error}", None, {})
    trace, figures = compare_window(wide, window)
    return TestResult(_SIZES, name, trace.valid, figures, INVARIANTS)


def _with_cells(model: ModelUnderTest, name: str, factor: float, effort: Effort) -> TestResult:
    """The same weights on cells of another size: particles then move more or fewer cells per frame than in training."""
    emulator = model.emulator
    cells = tuple(max(1, round(factor * n)) for n in emulator.grid.shape)
    try:
        other = adapted(emulator, dataclasses.replace(emulator.recipe, cells=cells))
    except ConfigError as error:
        return TestResult(_SIZES, f"grid {name}: {error}", None, {})
    if model.preset is None:
        window = Window.of(model.starts(1))
    else:
        window = simulate_window(model, model.preset, effort.scenes, effort.compared)
    _, figures = compare_window(model.with_emulator(other), window)
    return TestResult(_SIZES, f"grid {name}", None, figures)


def _symmetries(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    scene, grid, state = model.emulator.scene, model.emulator.grid, model.starts(effort.scenes)
    frames = 4 * model.horizon
    straight = rollout(model.emulator, state, frames)
    centre = state.position.new_tensor(scene.bounds).mean(1)
    mirror = centre.new_ones(scene.dim)
    mirror[0] = -1

    def reflect(values: Tensor) -> Tensor:
        return values * mirror

    def turn(values: Tensor) -> Tensor:
        return torch.stack([-values[..., 1], values[..., 0], *values.unbind(-1)[2:]], dim=-1)

    def back(values: Tensor) -> Tensor:
        return torch.stack([values[..., 1], -values[..., 0], *values.unbind(-1)[2:]], dim=-1)

    moves = {"reflection": (reflect, reflect)}
    if scene.dim > 1 and scene.bounds[0] == scene.bounds[1] and grid.shape[0] == grid.shape[1]:
        moves["a quarter turn, gravity with it"] = (turn, back)
    for name, (there, home) in moves.items():
        moved = dataclasses.replace(
            state,
            position=centre + there(state.position - centre),
            velocity=there(state.velocity),
            obstacle=centre + there(state.obstacle - centre),
            gravity=there(state.gravity),
        )
        other = centre + home(rollout(model.emulator, moved, frames) - centre)
        yield _difference(model, name, state, straight, other)
    yield _shift(model, state, straight)


def _shift(model: ModelUnderTest, state: Particles, straight: Tensor) -> TestResult:
    """Box and particles moved by half a cell over the same grid."""
    scene = model.emulator.scene
    by = 0.5 * model.emulator.grid.spacing[0]
    name = "a shift by half a cell"
    (low, high), *others = scene.bounds
    if high + by > scene.domain[0][1]:
        return TestResult(_SIZES, f"{name}: the wall layer is too thin", None, {})
    shifted = model.emulator.over(dataclasses.replace(scene, bounds=((low + by, high + by), *others)))
    offset = state.position.new_tensor([by] + [0.0] * (scene.dim - 1))
    moved = dataclasses.replace(state, position=state.position + offset, obstacle=state.obstacle + offset)
    return _difference(model, name, state, straight, rollout(shifted, moved, straight.shape[1]) - offset)


def _difference(model: ModelUnderTest, name: str, state: Particles, one: Tensor, other: Tensor) -> TestResult:
    distance = rms_distance(model.emulator.grid, state.mask, one, other)
    figures = {f"apart_cells_at_{frame}": float(distance[frame - 1]) for frame in (model.horizon, len(distance))}
    return TestResult(_SIZES, name, None, figures)
