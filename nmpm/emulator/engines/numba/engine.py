"""The engine of Numba kernels for rollouts on a CPU: arrays from the state to the positions.

Only the network takes tensors: a dispatch of torch takes as long as a kernel does on a small scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.jit import jit
from nmpm._support.threads import map_ranges, split
from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.engines.engine import Engine, Flight
from nmpm.emulator.engines.numba.arrays import ArrayCache, as_array, as_grid, check_materials
from nmpm.emulator.engines.numba.contact import keep_clear
from nmpm.emulator.engines.numba.crowding import spread_crowds
from nmpm.emulator.engines.numba.parameters import Array, KernelParameters
from nmpm.emulator.engines.numba.path import CHUNK, find_path
from nmpm.emulator.engines.numba.rest import bring_to_rest
from nmpm.emulator.engines.numba.solids import SolidCache, prepare_solids
from nmpm.emulator.engines.numba.state import StartArrays, normalise, output_array, rasterise, unpack
from nmpm.particles import Particles

_STATISTICS = ("input_low", "input_high", "input_mean", "input_std")


@dataclass(frozen=True)
class NumbaEngine(Engine[StartArrays, Array]):
    """All steps as kernels, for rollouts without gradients on a CPU."""

    parameters: KernelParameters
    name = "numba"

    def prepare(self, solid: Tensor, budget: Tensor | None) -> RolloutContext:
        return RolloutContext(solid, budget, prepare_solids(self.parameters, solid, self.emulator.walls), ArrayCache())

    def rasterise(self, particles: Particles, context: RolloutContext) -> StartArrays:
        cached, single = _cache(context).array, len(self.parameters.mass) == 1
        kinds = np.empty((len(particles.position), 0), np.int64) if single else cached("material", particles.material)
        return rasterise(
            self.parameters, as_array(particles.position), as_array(particles.velocity),
            cached("gravity", particles.gravity), kinds, cached("mask", particles.mask),
            cached("solid", context.solid),
        )  # fmt: skip

    def normalise(self, start: StartArrays, context: RolloutContext) -> Tensor:
        low, high, mean, deviation = (self._statistic(name, context) for name in _STATISTICS)
        seen, rows = np.empty_like(start.state), (-1, self.parameters.channels)
        normalise(start.state.reshape(rows), low, high, mean, deviation, seen.reshape(rows))
        return as_grid(seen, self.parameters.shape)

    def fly(self, start: StartArrays, output: Tensor, context: RolloutContext) -> Flight[Array]:
        """As of every engine; raises IndexError if a particle's material is none of the scene's."""
        parameters, (batch, count, dim), frames = self.parameters, start.cells.shape, output.shape[1]
        check_materials(parameters, start.material)
        path = np.empty((batch, frames, count, dim), np.float32)  # asks for huge pages, which a fresh tensor does not
        fields = np.empty((frames, parameters.size, output.shape[2]), np.float32)
        predicted, scale = output_array(output), self._statistic("output_scale", context)
        threads, all_solids = torch.get_num_threads(), self._solids(context)
        for b in range(batch):
            unpack(predicted[b], scale, fields)
            scene, solids = start.real_scene(b), all_solids[b]
            real = len(scene.cells)
            path[b, :, real:] = start.cells[b, real:]  # padding stays
            find_path(scene, fields, parameters, _budget(context, b), path[b], threads)
            if parameters.obstacles and parameters.solids:
                keep_clear(scene, parameters, solids, path[b], threads)
            if parameters.rest_speed:
                bring_to_rest(scene, parameters, solids.obstacle, path[b], threads)
        return Flight(path, path[:, -1] - (path[:, -2] if frames > 1 else start.cells))

    def spread(self, start: StartArrays, flight: Flight[Array], context: RolloutContext) -> Flight[Array]:
        """As of every engine, in place."""
        threads, solids = torch.get_num_threads(), self._solids(context)
        for b, path in enumerate(flight.path):
            spread_crowds(start.real_scene(b), path, self.parameters, solids[b], _budget(context, b), threads)
        return flight

    def land(self, start: StartArrays, flight: Flight[Array]) -> Bundle:  # noqa: ARG002 (other engines')
        """As of every engine; the path's memory becomes the bundle's: fresh memory would take longer."""
        box, threads = self.parameters.box, torch.get_num_threads()
        for path in flight.path:
            map_ranges(partial(to_length, path, box), split(path.shape[1], CHUNK), threads)
        return Bundle(torch.from_numpy(flight.path), torch.from_numpy(flight.step * box[1]))

    def _statistic(self, name: str, context: RolloutContext) -> Any:
        return _cache(context).array(name, getattr(self.emulator, name)).reshape(-1)

    def _solids(self, context: RolloutContext) -> tuple[SolidCache, ...]:
        return context.solid_caches or prepare_solids(self.parameters, context.solid, self.emulator.walls)


def _cache(context: RolloutContext) -> ArrayCache:
    return context.array_cache or ArrayCache()


def _budget(context: RolloutContext, scene: int) -> float | None:
    return None if context.budget is None else float(_cache(context).array("budget", context.budget)[scene])


@jit
def to_length(path: Any, box: Any, low: Any, high: Any) -> Any:
    """Convert a path to domain length in place, by the (2, D) `box`."""
    for frame in range(len(path)):
        here = path[frame, low:high]  # a slice, as Numba's check for negative indices is slow
        for d in range(here.shape[1]):
            lowest, width = box[0, d], box[1, d]
            for p in range(len(here)):
                here[p, d] = here[p, d] * width + lowest
