"""Particle counts and densities: from none to millions, an empty box and a full one."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from nmpm.data.initial_states import lattice, state_at_rest, thrown_blocks
from nmpm.emulator.calibration import with_usual_gravity
from nmpm.emulator.rollouts import rollout
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject
from nmpm.evaluation.stress.trace import INVARIANTS, rms_distance, trace_rollout

_GROUP = "many and few"
_VOLUME_SHARE = 0.1
"""Share of the box that the block of material fills, whatever its number of particles."""


def counts(subject: Subject, size: Size) -> Iterator[Line]:
    """The same block of material in fewer and in more particles, and other densities."""
    yield from _with_counts(subject, size)
    for factor in (0.5, 2.0):
        yield _with_density(subject, factor, size)
    yield _empty_box(subject)
    yield _full_box(subject, size)


def _with_counts(subject: Subject, size: Size) -> Iterator[Line]:
    """The finest first, as the others' centres of mass are compared with its own."""
    volume, finest = _VOLUME_SHARE * subject.emulator.scene.volume, None
    for number in (10**power for power in reversed(range(8)) if 10**power <= size.particles):
        scene = dataclasses.replace(subject.emulator.scene, particle_volume=volume / number)
        state = with_usual_gravity(subject.emulator, thrown_blocks(scene, count=number, seed=subject.seed))
        state = state.to(subject.device)
        trace = trace_rollout(subject.emulator.over(scene), state, 2 * subject.horizon)
        centre = trace.last.mean(1)
        finest = centre if finest is None else finest
        cells = (centre - finest) / centre.new_tensor(subject.emulator.grid.spacing)
        figures = trace.figures() | {"centre_apart_cells": float(cells.norm())}
        yield Line(
            _GROUP, f"{state.position.shape[1]:,} particles of the same volume", trace.valid, figures, INVARIANTS
        )


def _with_density(subject: Subject, factor: float, size: Size) -> Line:
    """Positions scaled around each scene's centre of mass: densities that training never showed."""
    scene, state = subject.emulator.scene, subject.starts(size.scenes)
    real = state.mask.unsqueeze(-1)
    centre = (state.position * real).sum(1, keepdim=True) / real.sum(1, keepdim=True)
    low, high = state.position.new_tensor(scene.bounds).T
    position = (centre + (state.position - centre) * factor ** (-1 / scene.dim)).clamp(low, high)
    trace = trace_rollout(subject.emulator.over(scene), state.with_motion(position, state.velocity), subject.horizon)
    return Line(_GROUP, f"density × {factor:g}", trace.valid, trace.figures(), INVARIANTS)


def _empty_box(subject: Subject) -> Line:
    """A state without particles."""
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


def _full_box(subject: Subject, size: Size) -> Line:
    """A box full of particles, which can hardly move; coarser ones where too many would be needed."""
    scene = subject.emulator.scene
    scene = dataclasses.replace(scene, particle_volume=max(scene.particle_volume, scene.volume / size.particles))
    state = state_at_rest(scene, lattice(scene.bounds, scene.particle_spacing))
    state = with_usual_gravity(subject.emulator, state).to(subject.device)
    trace = trace_rollout(subject.emulator.over(scene), state, 4 * subject.horizon)
    moved = rms_distance(subject.emulator.grid, state.mask, state.position.unsqueeze(1), trace.last.unsqueeze(1))
    figures = trace.figures() | {"moved_cells": float(moved)}
    return Line(_GROUP, f"a full box ({state.position.shape[1]:,} particles)", trace.valid, figures, INVARIANTS)
