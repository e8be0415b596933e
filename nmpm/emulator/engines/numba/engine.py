"""The engine of Numba kernels for rollouts on a CPU: arrays from the state to the positions.

Only the network takes tensors: a dispatch of torch takes as long as a kernel does on a small scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
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
from nmpm.emulator.engines.numba.contact import keep_clear, keep_clear_of_moving
from nmpm.emulator.engines.numba.crowding import spread_crowds
from nmpm.emulator.engines.numba.parameters import Array
from nmpm.emulator.engines.numba.path import CHUNK, fill_gains, find_path
from nmpm.emulator.engines.numba.rest import bring_to_rest
from nmpm.emulator.engines.numba.solids import SolidCache, prepare_solids
from nmpm.emulator.engines.numba.state import ParticleArrays, StartArrays, normalise, output_array, rasterise, unpack
from nmpm.emulator.rasterise import solid_channels
from nmpm.particles import Particles

_STATISTICS = ("input_low", "input_high", "input_mean", "input_std")


@dataclass(frozen=True)
class PreparedArrays:
    """What the calls of a rollout share: the solids of each scene, and arrays of tensors."""

    solids: tuple[SolidCache, ...]
    arrays: ArrayCache = field(default_factory=ArrayCache)

    def scenes(self, chosen: list[int]) -> PreparedArrays:
        """The same for part of the batch."""
        return PreparedArrays(tuple(self.solids[scene] for scene in chosen))


class NumbaEngine(Engine[StartArrays, Array]):
    """All steps as kernels, for rollouts without gradients on a CPU."""

    name = "numba"

    def prepare(self, solid: Tensor, budget: Tensor | None) -> RolloutContext:
        return RolloutContext(solid, budget, PreparedArrays(self._prepare(solid)))

    def rasterise(self, particles: Particles, context: RolloutContext) -> StartArrays:
        cached, scales, scene = _cache(context).array, self.emulator.field_scales, self.emulator.scene
        batch, count = particles.mask.shape
        grid, transfer, nothing = self.emulator.grid, self.emulator.transfer, np.empty((batch, count, 0), np.float32)
        solid = solid_channels(scene, grid, transfer, particles, context.solid, torch.float32)
        arrays = ParticleArrays(
            as_array(particles.position), as_array(particles.velocity), cached("gravity", particles.gravity),
            cached("mask", particles.mask),
            cached("material", particles.material) if self.parameters.materials > 1 else np.empty((batch, 0), np.int64),
            np.empty((batch, 0), np.float32) if particles.volume is None else as_array(particles.volume.float()),
            as_array(scales.of_particles(particles)) if scene.particle_fields else nothing,
            as_array(scales.of_scene(particles)) if scene.parameters else np.empty((batch, 0), np.float32),
            cached("solid", solid),
        )  # fmt: skip
        start, solids = rasterise(self.parameters, arrays, self.emulator.frames), self.solids_ahead(particles)
        ahead = () if solids is None else [self._prepare(there.unsqueeze(1)) for there in solids.unbind(1)]
        return start._replace(fields=particles.fields, ahead=ahead)

    def normalise(self, start: StartArrays, context: RolloutContext) -> Tensor:
        low, high, mean, deviation = (self._statistic(name, context) for name in _STATISTICS)
        seen, rows = np.empty_like(start.state), (-1, self.parameters.channels)
        normalise(start.state.reshape(rows), low, high, mean, deviation, seen.reshape(rows))
        return as_grid(seen, self.parameters.shape)

    def fly(self, start: StartArrays, output: Tensor, context: RolloutContext) -> Flight[Array]:
        """As of every engine; raises IndexError if a particle's material is none of the scene's."""
        parameters, path, frames = self.parameters, start.path, output.shape[1]
        check_materials(parameters, start.material)
        predicted, scale = output_array(output), self._statistic("output_scale", context).reshape(frames, -1)
        threads, all_solids, first = torch.get_num_threads(), self._solids(context), parameters.volume_channels[0]
        fields = np.empty((frames, parameters.size, first), np.float32)
        for b in range(len(path)):
            scene, solids = start.real_scene(b), all_solids[b]
            path[b, 1:, len(scene.mask) :] = path[b, 0, len(scene.mask) :]  # padding stays
            unpack(predicted[b, :, :first], scale[:, :first], fields)
            find_path(scene, fields, parameters, _budget(context, b), threads)
            if parameters.obstacles and parameters.solids and start.ahead:
                keep_clear_of_moving(path[b], scene.mask, parameters, [solids[b] for solids in start.ahead], threads)
            elif parameters.obstacles and parameters.solids:
                keep_clear(path[b], scene.mask, parameters, solids, threads)
            if parameters.rest_speed:
                bring_to_rest(scene, parameters, solids.obstacle, threads)
        evolved = self._evolve(start, predicted[:, :, first:], scale[:, first:]) if output.shape[2] > first else {}
        return Flight(path[:, 1:], path[:, -1] - path[:, -2], evolved)

    def _evolve(self, start: StartArrays, predicted: Array, scale: Array) -> Mapping[str, Tensor]:
        """The evolving fields in the frames of a path, by the rates (B, m, M E, size) that the network predicts."""
        batch, frames, channels, size = predicted.shape
        rates = np.empty((frames, size, channels), np.float32)
        gains = np.zeros((batch, frames, start.path.shape[2], channels // self.parameters.materials), np.float32)
        values, threads = (0,) * gains.shape[3], torch.get_num_threads()
        for b in range(batch):
            scene = start.real_scene(b)
            unpack(predicted[b], scale, rates)
            gain = partial(fill_gains, scene.path, scene.material, self.parameters.g2p_grid, rates, gains[b], values)
            map_ranges(gain, split(len(scene.mask), CHUNK), threads)
        return self.emulator.field_scales.evolve(start.fields, torch.from_numpy(gains))

    def spread(self, start: StartArrays, flight: Flight[Array], context: RolloutContext) -> Flight[Array]:
        """As of every engine, in place."""
        threads, solids = torch.get_num_threads(), start.ahead[-1] if start.ahead else self._solids(context)
        for b in range(len(start.path)):
            spread_crowds(start.real_scene(b), self.parameters, solids[b], _budget(context, b), threads)
        return flight

    def land(self, start: StartArrays, flight: Flight[Array]) -> Bundle:  # noqa: ARG002 (other engines')
        """As of every engine; the path's memory becomes the bundle's: fresh memory would take longer."""
        box, threads = self.parameters.box, torch.get_num_threads()
        for path in flight.path:
            map_ranges(partial(to_length, path, box), split(path.shape[1], CHUNK), threads)
        return Bundle(torch.from_numpy(flight.path), torch.from_numpy(flight.step * box[1]), flight.fields)

    def _statistic(self, name: str, context: RolloutContext) -> Any:
        return _cache(context).array(name, getattr(self.emulator, name)).reshape(-1)

    def _solids(self, context: RolloutContext) -> tuple[SolidCache, ...]:
        return self._prepare(context.solid) if context.prepared is None else context.prepared.solids

    def _prepare(self, solid: Tensor) -> tuple[SolidCache, ...]:
        return prepare_solids(self.parameters, solid, self.emulator.walls)


def _cache(context: RolloutContext) -> ArrayCache:
    return ArrayCache() if context.prepared is None else context.prepared.arrays


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
