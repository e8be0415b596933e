"""Many and few: from no particle to millions, thin and dense, an empty box and a full one."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from nmpm.data.initial_states import lattice, resting, thrown_blocks
from nmpm.emulator.rollouts import rollout
from nmpm.evaluation.stress.course import SOUND, apart, run
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject

_GROUP = "many and few"
_SHARE = 0.1
"""Of the box: the volume that the counts share."""


def counts(subject: Subject, size: Size) -> Iterator[Line]:
    """The same block of material in fewer and in more particles, and other densities."""
    yield from _finer(subject, size)
    for factor in (0.5, 2.0):
        yield _denser(subject, factor, size)
    yield _nothing(subject)
    yield _full(subject, size)


def _finer(subject: Subject, size: Size) -> Iterator[Line]:
    """The finest comes first: its centre of mass is what those of the others are compared with."""
    volume, finest = _SHARE * subject.emulator.scene.volume, None
    for number in (10**power for power in reversed(range(8)) if 10**power <= size.particles):
        scene = dataclasses.replace(subject.emulator.scene, particle_volume=volume / number)
        state = thrown_blocks(scene, count=number, seed=subject.seed)
        course = run(subject.emulator.over(scene), state, 2 * subject.horizon)
        centre = course.last.mean(1)
        finest = centre if finest is None else finest
        cells = (centre - finest) / centre.new_tensor(subject.emulator.grid.spacing)
        figures = course.figures() | {"centre_apart_cells": float(cells.norm())}
        yield Line(_GROUP, f"{state.position.shape[1]:,} particles of the same volume", course.sound, figures, SOUND)


def _denser(subject: Subject, factor: float, size: Size) -> Line:
    """Each scene's particles drawn together, or apart, around their centre of mass: other densities than were seen."""
    scene, state = subject.emulator.scene, subject.starts(size.scenes)
    real = state.mask.unsqueeze(-1)
    centre = (state.position * real).sum(1, keepdim=True) / real.sum(1, keepdim=True)
    low, high = state.position.new_tensor(scene.bounds).T
    position = (centre + (state.position - centre) * factor ** (-1 / scene.dim)).clamp(low, high)
    course = run(subject.emulator.over(scene), state.moved(position, state.velocity), subject.horizon)
    return Line(_GROUP, f"density × {factor:g}", course.sound, course.figures(), SOUND)


def _nothing(subject: Subject) -> Line:
    """Obstacles, if the scene has any, and no particle."""
    state = subject.starts(1)
    empty = dataclasses.replace(
        state,
        position=state.position[:, :0],
        velocity=state.velocity[:, :0],
        material=state.material[:, :0],
        mask=state.mask[:, :0],
    )
    predicted = rollout(subject.emulator, empty, subject.horizon)
    return Line(_GROUP, "no particle", predicted.shape == (1, subject.horizon, 0, predicted.shape[-1]), {}, "no error")


def _full(subject: Subject, size: Size) -> Line:
    """Nowhere to go: what fills the box hardly moves. The particles are coarser where too many would be needed."""
    scene = subject.emulator.scene
    scene = dataclasses.replace(scene, particle_volume=max(scene.particle_volume, scene.volume / size.particles))
    state = resting(scene, lattice(scene.bounds, scene.particle_spacing))
    course = run(subject.emulator.over(scene), state, 4 * subject.horizon)
    moved = apart(subject.emulator.grid, state.mask, state.position.unsqueeze(1), course.last.unsqueeze(1))
    figures = course.figures() | {"moved_cells": float(moved)}
    return Line(_GROUP, f"a full box ({state.position.shape[1]:,} particles)", course.sound, figures, SOUND)
