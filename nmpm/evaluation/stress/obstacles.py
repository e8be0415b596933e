"""Unseen scenes: floors, a hole, a moving bar, an inlet, fast particles against a wall one cell thick.

Obstacles are put only into scenes whose model sees walls or obstacles at all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from nmpm.emulator.calibration import with_usual_gravity
from nmpm.emulator.model import Emulator
from nmpm.emulator.rollouts import unroll
from nmpm.evaluation.stress.model import ModelUnderTest
from nmpm.evaluation.stress.results import Effort, TestResult
from nmpm.evaluation.stress.trace import is_lost
from nmpm.particles import Particles, lattice, state_at_rest
from nmpm.scene import Interval

Forbidden = Callable[[Tensor, int], Tensor]
"""Given (N, D) positions and the index of the bundle: which particles are in a forbidden place, (N,) bool."""

Change = Callable[[Particles, int], Particles]
"""Given a state and the index of the next bundle: the state with obstacles moved or particles added."""

_GROUP = "unseen scenes"
_DEEP = 0.5  # cells: penetration of a solid that is tolerated


def obstacles(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """Walls, obstacles and sources added to a model that never saw them."""
    scene = model.emulator.scene
    bundles = max(1, effort.compared // model.emulator.frames)
    if scene.walled and scene.dim > 1 and not any(scene.periodic):
        emulator = model.emulator.over(dataclasses.replace(scene, obstacles=True))
        for cells in (3, 1):
            yield _floor(emulator, f"a floor {cells} cells thick", cells, 0.0, bundles)
        yield _floor(emulator, "2 cells per frame against one cell", 1, 2.0, bundles)
        yield _hole(emulator, bundles)
        yield _moving_bar(emulator, bundles)
    yield _inlet(model.emulator, bundles)


def _floor(emulator: Emulator, name: str, cells: int, speed: float, bundles: int) -> TestResult:
    """A block falls onto a slab from wall to wall."""
    slab = _slab(emulator, cells)
    state = _block(emulator, slab, speed, lattice(slab, emulator.scene.particle_spacing))
    low, high = slab[1]
    deep = high - _DEEP * emulator.grid.spacing[1]
    forbidden: dict[str, Forbidden] = {
        "in_or_below": lambda position, _: position[:, 1] < deep,
        "below": lambda position, _: position[:, 1] < low,
    }
    return _result(name, emulator, state, bundles, forbidden, "no particle half a cell deep in it, none below")


def _hole(emulator: Emulator, bundles: int) -> TestResult:
    """The slab has a hole eight cells wide under the block."""
    slab = _slab(emulator, 3)
    (left, right), (low, high), *rest = slab
    middle, half = (left + right) / 2, 4 * emulator.grid.spacing[0]
    sides = [((left, middle - half), (low, high), *rest), ((middle + half, right), (low, high), *rest)]
    solid = torch.cat([lattice(side, emulator.scene.particle_spacing) for side in sides])
    state = _block(emulator, slab, 0.0, solid)
    deep = [_DEEP * h for h in emulator.grid.spacing]

    def within(position: Tensor, _: int) -> Tensor:
        upright = (position[:, 1] < high - deep[1]) & (position[:, 1] > low + deep[1])
        return upright & ((position[:, 0] - middle).abs() > half + deep[0])

    forbidden = {"in_the_floor": within, "through_the_hole": lambda position, _: position[:, 1] < low}
    needs = "no particle half a cell deep in the floor"
    return _result("a hole in the floor", emulator, state, bundles, forbidden, needs)


def _moving_bar(emulator: Emulator, bundles: int) -> TestResult:
    """A bar three cells thick and half as high as the box sweeps from the left, 0.4 cells per bundle."""
    scene, h = emulator.scene, emulator.grid.spacing[0]
    (left, right), (low, high), *rest = scene.bounds
    first = (left, left + 3 * h)
    still = lattice((first, (low, (low + high) / 2), *rest), scene.particle_spacing)
    block = lattice(((left + 6 * h, (left + right) / 2), (low, (3 * low + high) / 4), *rest), scene.particle_spacing)
    state = _at_rest(emulator, block, still)
    still = state.obstacle[0]

    def offset(bundle: int) -> float:
        return min(0.4 * bundle * h, (right - left) / 2)

    def sweep(state: Particles, bundle: int) -> Particles:
        shift = still.new_tensor([offset(bundle)] + [0.0] * (scene.dim - 1))
        return dataclasses.replace(state, obstacle=(still + shift)[None])

    def within(position: Tensor, bundle: int) -> Tensor:
        along = (position[:, 0] - offset(bundle) - sum(first) / 2).abs() < (1.5 - 2 * _DEEP) * h
        return along & (position[:, 1] < (low + high) / 2 - h)

    needs = "no particle a cell deep in it"
    return _result("a bar that moves", emulator, state, bundles, {"in_the_bar": within}, needs, sweep)


def _inlet(emulator: Emulator, bundles: int) -> TestResult:
    """Every fifth bundle a small block enters at the top."""
    scene, h = emulator.scene, emulator.grid.spacing
    sides = [
        ((low + high) / 2 - 3 * step, (low + high) / 2 + 3 * step)
        for (low, high), step in zip(scene.bounds, h, strict=True)
    ]
    if scene.dim > 1:
        sides[1] = (scene.bounds[1][1] - 8 * h[1], scene.bounds[1][1] - 2 * h[1])
    fresh = _at_rest(emulator, lattice(tuple(sides), scene.particle_spacing))

    def feed(state: Particles, bundle: int) -> Particles:
        return _concatenate(state, fresh) if bundle % 5 == 0 and bundle else state

    forbidden: dict[str, Forbidden] = {"lost": lambda position, _: is_lost(scene, position)}
    return _result("an inlet", emulator, fresh, bundles, forbidden, "no particle lost", feed)


def _concatenate(one: Particles, other: Particles) -> Particles:
    """The particles of two states, with the obstacles of the first, and without fields, which only one may have."""
    names = ("position", "velocity", "material", "mask")
    both: dict[str, Any] = {name: torch.cat([getattr(one, name), getattr(other, name)], dim=1) for name in names}
    return dataclasses.replace(one, **both, fields={})


def _result(
    name: str,
    emulator: Emulator,
    state: Particles,
    bundles: int,
    forbidden: Mapping[str, Forbidden],
    needs: str,
    change: Change = lambda state, _: state,
) -> TestResult:
    """Roll out, and count at each frame the particles in forbidden places, or non-finite: the most at any frame.

    The first of the counts must be zero.
    """
    most = dict.fromkeys(forbidden, 0)
    for bundle in range(bundles):
        state = change(state, bundle)
        (made,) = unroll(emulator, state, 1)
        for position in made.position[0]:
            broken = ~position.isfinite().all(-1)
            for where, is_there in forbidden.items():
                most[where] = max(most[where], int((is_there(position, bundle) | broken).sum()))
        state = made.state_after(state)
    return TestResult(_GROUP, name, not next(iter(most.values())), most | {"of": state.position.shape[1]}, needs)


def _slab(emulator: Emulator, cells: int) -> tuple[Interval, ...]:
    """A slab from wall to wall, its top in the middle of the box."""
    bounds, step = emulator.scene.bounds, emulator.grid.spacing[1]
    top = (bounds[1][0] + bounds[1][1]) / 2
    return (emulator.scene.domain[0], (top - cells * step, top), *emulator.scene.domain[2:])


def _block(emulator: Emulator, slab: tuple[Interval, ...], speed: float, solid: Tensor) -> Particles:
    """A block above the middle of a slab, thrown down, in cells per frame."""
    scene, h = emulator.scene, emulator.grid.spacing
    box = [(low + (high - low) / 3, high - (high - low) / 3) for low, high in scene.bounds]
    box[1] = (slab[1][1] + 2 * h[1], slab[1][1] + 16 * h[1])
    state = _at_rest(emulator, lattice(tuple(box), scene.particle_spacing), solid)
    down = state.velocity.new_tensor([0.0, -speed * h[1]] + [0.0] * (scene.dim - 2))
    return state.with_motion(state.position, state.velocity + down)


def _at_rest(emulator: Emulator, position: Tensor, solid: Tensor | None = None) -> Particles:
    """Particles (N, D) at rest, and perhaps obstacle particles (M, D), on the emulator's device."""
    return with_usual_gravity(emulator, state_at_rest(emulator.scene, position, solid)).to(emulator.device)
