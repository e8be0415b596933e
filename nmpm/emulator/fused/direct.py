"""A bundle by the kernels, without gradients: arrays from the state to the positions.

Only the network takes tensors: a dispatch of torch takes as long as a kernel does on a small scene.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.fused.arrays import as_array
from nmpm.emulator.fused.batch import Batch, fly_batch, land_batch, rasterise_batch, spread_batch, to_grid
from nmpm.emulator.fused.flight import last_velocity
from nmpm.emulator.fused.plan import Array, Plan
from nmpm.emulator.fused.surroundings import Surroundings, survey
from nmpm.emulator.fused.views import Views
from nmpm.particles import Particles
from nmpm.transfer.fused.state import normalise

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator

_STATISTICS = ("input_low", "input_high", "input_mean", "input_std")


def predict(emulator: Emulator, plan: Plan, particles: Particles, context: RolloutContext) -> Bundle:
    """The bundle of an emulator in evaluation mode, see `Emulator.predict`."""
    call = DirectCall(emulator, plan, context)
    start = call.rasterise(particles)
    output = emulator.runtime.fields(emulator.processor, call.normalise(start), emulator.network_precision)
    return call.finish(start, call.path(start, output))


class DirectCall:
    """The parts of one call of an emulator.

    Args:
        emulator: In evaluation mode.
        plan: Of the emulator.
        context: Of the rollout.
    """

    def __init__(self, emulator: Emulator, plan: Plan, context: RolloutContext) -> None:
        self._emulator, self._plan, self._context = emulator, plan, context
        self._views = Views() if context.views is None else context.views

    def rasterise(self, particles: Particles) -> Batch:
        """Particles in grid units, and the grid state."""
        view, own = self._views.array, particles
        count = len(own.position)
        single = len(self._plan.mass) == 1
        kinds = np.empty((count, 0), np.int64) if single else view("material", own.material)
        return rasterise_batch(
            self._plan, as_array(own.position), as_array(own.velocity), view("gravity", own.gravity), kinds,
            view("mask", own.mask), view("solid", self._context.solid),
        )  # fmt: skip

    def normalise(self, start: Batch) -> Tensor:
        """(B, C_in, *S), as `Emulator.normalise` of the grid state."""
        low, high, mean, deviation = (self._statistic(name) for name in _STATISTICS)
        seen, rows = np.empty_like(start.state), (-1, self._plan.channels)
        normalise(start.state.reshape(rows), low, high, mean, deviation, seen.reshape(rows))
        return to_grid(self._plan, seen)

    def path(self, start: Batch, output: Tensor) -> Array:
        """(B, m, N, D) positions in cells, held to the emulator's constraints but the density cap."""
        scale = self._statistic("output_scale")
        return fly_batch(self._plan, start, output, scale, self._budget, self._known)

    def finish(self, start: Batch, path: Array) -> Bundle:
        """The bundle of a path, whose memory is used for it."""
        velocity = np.empty_like(start.cells)
        for scene in range(len(velocity)):
            last_velocity(start.cells[scene], path[scene], self._plan.box, velocity[scene])
        if self._plan.density_cap:
            # Spreading is no motion of the material: the velocity is that of the path without it.
            path = spread_batch(self._plan, start, path, self._budget, self._known)
        return Bundle(torch.from_numpy(land_batch(self._plan, path)), torch.from_numpy(velocity))

    def _statistic(self, name: str) -> Any:
        return self._views.array(name, getattr(self._emulator, name)).reshape(-1)

    @property
    def _budget(self) -> Any:
        budget = self._context.budget
        return None if budget is None else self._views.array("budget", budget)

    @property
    def _known(self) -> tuple[Surroundings, ...]:
        known = self._context.surroundings
        return survey(self._plan, self._context.solid, self._emulator.walls) if known is None else known
