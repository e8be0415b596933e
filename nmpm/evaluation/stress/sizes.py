"""Size and symmetry: wider boxes, other grids, and rollouts of rotated, mirrored and shifted scenes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import torch
from torch import Tensor

from nmpm.emulator.rollouts import rollout
from nmpm.errors import ConfigError
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.speeds import compare_window
from nmpm.evaluation.stress.subject import Subject, simulate_window
from nmpm.evaluation.stress.trace import INVARIANTS, rms_distance
from nmpm.particles import Particles, Window
from nmpm.scene import Scene

_GROUP = "size and symmetry"


def sizes(subject: Subject, size: Size) -> Iterator[Line]:
    """Domains twice and four times as wide, cells half and twice as wide, and symmetries of the box."""
    for times in (2, 4):
        yield _wide(subject, times, size)
    for name, factor in (("refined", 2), ("coarsened", 0.5)):
        yield _with_cells(subject, name, factor, size)
    yield from _symmetries(subject, size)


def _wide(subject: Subject, times: int, size: Size) -> Line:
    name = f"domain {times} × as wide"
    if subject.preset is not None:
        preset = subject.preset.widened(times)
        window, scene = simulate_window(subject, preset, size.scenes, size.compared), preset.scene
    else:
        window, scene = Window.of(subject.starts(1)), widen_scene(subject.emulator.scene, times)
    try:
        wide = subject.with_emulator(subject.emulator.over(scene))
    except ConfigError as error:
        return Line(_GROUP, f"{name}: {error}", None, {})
    trace, figures = compare_window(wide, window)
    return Line(_GROUP, name, trace.valid, figures, INVARIANTS)


def widen_scene(scene: Scene, times: int) -> Scene:
    """A scene whose domain is `times` as wide, with the same wall layers."""
    longer = (times - 1) * (scene.domain[0][1] - scene.domain[0][0])
    return dataclasses.replace(
        scene,
        bounds=((scene.bounds[0][0], scene.bounds[0][1] + longer), *scene.bounds[1:]),
        domain=((scene.domain[0][0], scene.domain[0][1] + longer), *scene.domain[1:]),
    )


def _with_cells(subject: Subject, name: str, factor: float, size: Size) -> Line:
    """The same weights on cells of another size: particles then move more or fewer cells per frame than in training."""
    mine = subject.emulator
    cells = [max(1, round(factor * n)) for n in mine.grid.shape]
    try:
        other = mine.rebuilt(dataclasses.replace(mine.recipe, cells=tuple(cells)))
    except ConfigError as error:
        return Line(_GROUP, f"grid {name}: {error}", None, {})
    if subject.preset is None:
        window = Window.of(subject.starts(1))
    else:
        window = simulate_window(subject, subject.preset, size.scenes, size.compared)
    _, figures = compare_window(subject.with_emulator(other), window)
    return Line(_GROUP, f"grid {name}", None, figures)


def _symmetries(subject: Subject, size: Size) -> Iterator[Line]:
    scene, grid, state = subject.emulator.scene, subject.emulator.grid, subject.starts(size.scenes)
    frames = 4 * subject.horizon
    straight = rollout(subject.emulator, state, frames)
    centre = state.position.new_tensor(scene.bounds).mean(1)
    mirror = centre.new_ones(scene.dim)
    mirror[0] = -1

    def mirror_first_axis(values: Tensor) -> Tensor:
        return values * mirror

    def turn(values: Tensor) -> Tensor:
        return torch.stack([-values[..., 1], values[..., 0], *values.unbind(-1)[2:]], dim=-1)

    def back(values: Tensor) -> Tensor:
        return torch.stack([values[..., 1], -values[..., 0], *values.unbind(-1)[2:]], dim=-1)

    moves = {"reflection": (mirror_first_axis, mirror_first_axis)}
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
        other = centre + home(rollout(subject.emulator, moved, frames) - centre)
        yield _difference(subject, name, state, straight, other)
    yield _shift_line(subject, state, straight)


def _shift_line(subject: Subject, state: Particles, straight: Tensor) -> Line:
    """Box and particles moved by half a cell over the same grid."""
    scene = subject.emulator.scene
    by = 0.5 * subject.emulator.grid.spacing[0]
    name = "a shift by half a cell"
    (low, high), *others = scene.bounds
    if high + by > scene.domain[0][1]:
        return Line(_GROUP, f"{name}: the wall layer is too thin", None, {})
    shifted = subject.emulator.over(dataclasses.replace(scene, bounds=((low + by, high + by), *others)))
    offset = state.position.new_tensor([by] + [0.0] * (scene.dim - 1))
    moved = dataclasses.replace(state, position=state.position + offset, obstacle=state.obstacle + offset)
    return _difference(subject, name, state, straight, rollout(shifted, moved, straight.shape[1]) - offset)


def _difference(subject: Subject, name: str, state: Particles, one: Tensor, other: Tensor) -> Line:
    distance = rms_distance(subject.emulator.grid, state.mask, one, other)
    figures = {f"apart_cells_at_{frame}": float(distance[frame - 1]) for frame in (subject.horizon, len(distance))}
    return Line(_GROUP, name, None, figures)
