"""A call of an emulator by the kernels, without gradients: arrays from the state to the positions.

Only the network takes tensors: a dispatch of torch takes as long as a kernel does on a small scene.
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.jit import jit
from nmpm._support.threads import map_ranges, split
from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.fused.arrays import ArrayCache, as_array, as_grid, check_materials
from nmpm.emulator.fused.contact import keep_clear
from nmpm.emulator.fused.crowding import spread_crowds
from nmpm.emulator.fused.parameters import Array, KernelParameters
from nmpm.emulator.fused.path import CHUNK, find_path
from nmpm.emulator.fused.rest import bring_to_rest
from nmpm.emulator.fused.solids import SolidCache, prepare_solids
from nmpm.emulator.fused.state import StartArrays, normalise, output_array, rasterise, unpack
from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator

_STATISTICS = ("input_low", "input_high", "input_mean", "input_std")


def predict(emulator: Emulator, parameters: KernelParameters, particles: Particles, context: RolloutContext) -> Bundle:
    """The bundle of an emulator in evaluation mode, see `Emulator.predict`."""
    call = KernelCall(emulator, parameters, context)
    start = call.rasterise(particles)
    output = emulator.runtime.fields(emulator.processor, call.normalise(start), emulator.network_precision)
    return call.finish(start, call.path(start, output))


class KernelCall:
    """The parts of one call of an emulator in evaluation mode."""

    def __init__(self, emulator: Emulator, parameters: KernelParameters, context: RolloutContext) -> None:
        self._emulator, self._parameters, self._context = emulator, parameters, context
        self._cache = context.array_cache or ArrayCache()

    def rasterise(self, particles: Particles) -> StartArrays:
        """Particles in grid units, and the grid state."""
        cached, single = self._cache.array, len(self._parameters.mass) == 1
        kinds = np.empty((len(particles.position), 0), np.int64) if single else cached("material", particles.material)
        return rasterise(
            self._parameters, as_array(particles.position), as_array(particles.velocity),
            cached("gravity", particles.gravity), kinds, cached("mask", particles.mask),
            cached("solid", self._context.solid),
        )  # fmt: skip

    def normalise(self, start: StartArrays) -> Tensor:
        """(B, C_in, *S), as `Emulator.normalise` of the grid state."""
        low, high, mean, deviation = (self._statistic(name) for name in _STATISTICS)
        seen, rows = np.empty_like(start.state), (-1, self._parameters.channels)
        normalise(start.state.reshape(rows), low, high, mean, deviation, seen.reshape(rows))
        return as_grid(seen, self._parameters.shape)

    def path(self, start: StartArrays, output: Tensor) -> Array:
        """(B, m, N, D) positions in cells, as `Advection.constrained_path` of an output (B, m, C, *S).

        Raises IndexError if a particle's material is none of the scene's.
        """
        parameters, (batch, count, dim), frames = self._parameters, start.cells.shape, output.shape[1]
        check_materials(parameters, start.material)
        path = np.empty((batch, frames, count, dim), np.float32)  # asks for huge pages, which a fresh tensor does not
        fields = np.empty((frames, parameters.size, output.shape[2]), np.float32)
        predicted, scale, threads = output_array(output), self._statistic("output_scale"), torch.get_num_threads()
        for b in range(batch):
            unpack(predicted[b], scale, fields)
            scene, solids = start.scene(b), self._solids[b]
            find_path(scene, fields, parameters, self._budget(b), path[b], threads)
            if parameters.obstacles and parameters.solids:
                keep_clear(scene, parameters, solids, path[b], threads)
            if parameters.rest_speed:
                bring_to_rest(scene, parameters, solids.obstacle, path[b], threads)
        return path

    def finish(self, start: StartArrays, path: Array) -> Bundle:
        """The bundle of a path, whose memory is used for it: fresh memory would take longer than the conversion."""
        parameters, threads = self._parameters, torch.get_num_threads()
        velocity = (path[:, -1] - (path[:, -2] if path.shape[1] > 1 else start.cells)) * parameters.box[1]
        for b, frames in enumerate(path):
            if parameters.density_cap:
                # Spreading is no motion of the material: the velocity is that of the path without it.
                spread_crowds(start.scene(b), frames, parameters, self._solids[b], self._budget(b), threads)
            map_ranges(partial(to_length, frames, parameters.box), split(frames.shape[1], CHUNK), threads)
        return Bundle(torch.from_numpy(path), torch.from_numpy(velocity))

    def _statistic(self, name: str) -> Any:
        return self._cache.array(name, getattr(self._emulator, name)).reshape(-1)

    def _budget(self, scene: int) -> float | None:
        budget = self._context.budget
        return None if budget is None else float(self._cache.array("budget", budget)[scene])

    @cached_property
    def _solids(self) -> tuple[SolidCache, ...]:
        context = self._context
        return context.solid_caches or prepare_solids(self._parameters, context.solid, self._emulator.walls)


@jit
def to_length(path: Any, box: Any, low: Any, high: Any) -> Any:
    """Convert a path to domain length in place, by the (2, D) `box`."""
    for frame in range(len(path)):
        here = path[frame, low:high]  # a slice, as Numba's check for negative indices is slow
        for d in range(here.shape[1]):
            lowest, width = box[0, d], box[1, d]
            for p in range(len(here)):
                here[p, d] = here[p, d] * width + lowest
