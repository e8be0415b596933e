"""The grid state of particles, the network's input from it, and the fields from the network's output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nmpm._support.jit import jit
from nmpm._support.threads import map_ranges, split
from nmpm.emulator.engines.numba.parameters import Array, KernelParameters
from nmpm.emulator.engines.numba.scatter import scatter
from nmpm.emulator.engines.numba.solids import SolidCache
from nmpm.transfer import LEAST_SHARE

_CHUNK = 2**16  # particles; each chunk has a grid of its own, so that sums do not depend on the number of threads
_BLOCK = 64  # nodes
ONE = np.float32(1)
_LEAST = np.float32(LEAST_SHARE)


class StartArrays(NamedTuple):
    """Particles and grid state at a bundle's start, see `numba`; of B scenes: with a first axis (B,).

    `fields` are those of the particles; `ahead` has the solids of all scenes at each frame, where obstacles move.
    """

    path: Array
    velocity: Array
    gravity: Array
    material: Array
    mask: Array
    volume: Array
    state: Array
    fields: Mapping[str, Tensor] = MappingProxyType({})
    ahead: Sequence[Sequence[SolidCache]] = ()

    def scene(self, index: int) -> StartArrays:
        """The arrays of one of the scenes."""
        return StartArrays(*(values[index] for values in self[:7]))

    def real_scene(self, index: int) -> StartArrays:
        """One of the scenes without the padding at its end, but for the path."""
        scene = self.scene(index)
        n = count_real(scene.mask)
        return scene._replace(
            velocity=scene.velocity[:n], material=scene.material[:n], mask=scene.mask[:n], volume=scene.volume[:n]
        )


def count_real(mask: Array) -> int:
    """Particles of a mask (N,) but the padding at its end; all if there is nothing else."""
    return len(mask) - int(mask[::-1].argmax()) if len(mask) else 0


class ParticleArrays(NamedTuple):
    """What `rasterise` takes of B scenes, as in `Particles` but for empty last axes.

    Args:
        position, velocity, gravity, mask: As there.
        material: (B, 0) where there is only one.
        volume: (B, 0) where all particles have the scene's.
        values: (B, N, P) fields of the particles, and
        constants: (B, G) of the scenes, as `FieldScales` gives them.
        solid: (B, C, *S) channels of the solids.
    """

    position: Array
    velocity: Array
    gravity: Array
    mask: Array
    material: Array
    volume: Array
    values: Array
    constants: Array
    solid: Array


def rasterise(parameters: KernelParameters, particles: ParticleArrays, frames: int) -> StartArrays:
    """Particles in grid units and the grid state, as `nmpm.emulator.rasterise.grid_state`.

    The paths have memory for so many frames after the first.
    """
    position = particles.position
    batch, count, dim = position.shape
    # Memory of NumPy's asks for huge pages, which that of a fresh tensor does not.
    path, moved = np.empty((batch, frames + 1, count, dim), np.float32), np.empty(position.shape, np.float32)
    pull = particles.gravity / parameters.box[1]
    state = np.empty((batch, parameters.size, parameters.channels), np.float32)
    for b in range(batch):
        sums = _sum_particles(parameters, ParticleArrays(*(each[b] for each in particles)), path[b, 0], moved[b])
        fill_state(
            sums, dim, particles.values.shape[2], np.float32(parameters.particle_volume),
            particles.solid[b].reshape(-1, parameters.size), pull[b] if parameters.constants else pull[b, :0],
            particles.constants[b], state[b],
        )  # fmt: skip
    return StartArrays(path, moved, pull, particles.material, particles.mask, particles.volume, state)


def _sum_particles(parameters: KernelParameters, scene: ParticleArrays, cells: Array, moved: Array) -> Array:
    """Fill in positions and velocities (N, D) of a scene in grid units, and return the sums of `scatter`.

    Of velocities and fields; where particles have volumes, times those, which then are a further value.
    """
    materials, width = len(parameters.mass), cells.shape[1] + scene.values.shape[1] + bool(len(scene.volume))
    real = count_real(scene.mask)
    to_cells(scene.position[real:], scene.velocity[real:], parameters.box, cells[real:], moved[real:])

    def add(low: int, high: int) -> Array:
        sums = np.zeros((parameters.size, materials * (width + 1)), np.float32)
        here, values = cells[low:high], moved[low:high]
        to_cells(scene.position[low:high], scene.velocity[low:high], parameters.box, here, values)
        if scene.values.shape[1]:
            values = np.concatenate((values, scene.values[low:high]), axis=1)
        if len(scene.volume):
            volume = scene.volume[low:high, None]
            values = np.concatenate((values * volume, volume), axis=1)
        scatter(values, scene.material[low:high], scene.mask[low:high], here, parameters.p2g_grid, sums)
        return sums

    parts = map_ranges(add, split(real, max(_CHUNK, 4 * parameters.size)), torch.get_num_threads())
    total = parts[0] if parts else np.zeros((parameters.size, materials * (width + 1)), np.float32)
    for part in parts[1:]:
        total += part
    return total


@jit
def to_cells(position: Any, velocity: Any, box: Any, cells: Any, moved: Any) -> Any:
    """Fill in positions and velocities (N, D) in cells, from those in domain length and the (2, D) `box`."""
    for d in range(position.shape[1]):
        lowest, width = box[0, d], box[1, d]
        for p in range(len(position)):
            cells[p, d] = (position[p, d] - lowest) / width
            moved[p, d] = velocity[p, d] / width


@jit
def fill_state(
    sums: Any, dim: Any, fields: Any, particle_volume: Any, solid: Any, gravity: Any, constants: Any, state: Any
) -> Any:
    """Fill in the channels of a grid state (size, C_in), in the order of `Scene.input_channels`.

    Args:
        sums: (size, M V + M) of the values of each material, then numbers of particles; V is `dim + fields`, or one
            more: the volume, which then stands for the number.
        particle_volume: In cells.
        solid: (C, size) channels of the solids.
        gravity, constants: (D,), (G,) the same everywhere; empty where there are no such channels.
        state: Is filled.
    """
    materials = (state.shape[1] - len(solid) - len(gravity) - len(constants)) // (dim + 1 + fields)
    width, first_solid = sums.shape[1] // materials - 1, materials * (dim + 1)
    counts, apart = (materials * width, 1) if width == dim + fields else (width - 1, width)
    first_gravity, first_constant = first_solid + len(solid), state.shape[1] - len(constants)
    first_field = first_gravity + len(gravity)
    for node in range(len(sums)):
        for kind in range(materials):
            count = sums[node, counts + apart * kind]
            total = count if count > _LEAST else ONE
            for k in range(dim):
                state[node, kind * dim + k] = sums[node, kind * width + k] / total
            state[node, materials * dim + kind] = count * particle_volume
            for k in range(fields):
                state[node, first_field + kind * fields + k] = sums[node, kind * width + dim + k] / total
    for k in range(len(solid)):
        state[:, first_solid + k] = solid[k]
    for k in range(len(gravity)):
        state[:, first_gravity + k] = gravity[k]
    for k in range(len(constants)):
        state[:, first_constant + k] = constants[k]


@jit
def normalise(state: Any, low: Any, high: Any, mean: Any, deviation: Any, out: Any) -> Any:
    """Fill in the network's input (size, C) for a grid state, as `Emulator.normalise`; statistics (C,), NaN stays."""
    for c in range(state.shape[1]):
        least, most, middle, width = low[c], high[c], mean[c], deviation[c]
        for node in range(len(state)):
            value = state[node, c]
            value = most if value > most else value
            value = least if value < least else value
            out[node, c] = (value - middle) / width


def output_array(output: Tensor) -> Any:
    """A network's output (B, m, C, *S) as an array (B, m, C, size) of float32 and any strides, for `unpack`."""
    return output.detach().flatten(3).float().numpy()


@jit
def unpack(output: Any, scale: Any, fields: Any) -> Any:
    """Fill in the fields, whose channels lie next to each other, from an output (m, C, size) and its scale (m, C)."""
    for begin in range(0, fields.shape[1], _BLOCK):
        end = min(begin + _BLOCK, fields.shape[1])
        for frame in range(len(fields)):
            for c in range(fields.shape[2]):
                these, field = output[frame, c, begin:end], fields[frame, begin:end]
                factor = scale[frame, c]
                for node in range(len(these)):
                    field[node, c] = these[node] * factor
