"""The grid state of particles, the network's input from it, and the fields from the network's output."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nmpm._support.jit import jit
from nmpm._support.threads import map_ranges, split
from nmpm.emulator.engines.numba.parameters import Array, KernelParameters
from nmpm.emulator.engines.numba.scatter import scatter

_CHUNK = 2**16  # particles; each chunk has a grid of its own, so that sums do not depend on the number of threads
_BLOCK = 64  # nodes
_NONE = np.empty(0, np.float32)
ZERO, ONE = np.float32(0), np.float32(1)


class StartArrays(NamedTuple):
    """Particles and grid state at a bundle's start, see `numba`; of B scenes: with a first axis (B,)."""

    cells: Array
    velocity: Array
    gravity: Array
    material: Array
    mask: Array
    state: Array

    def scene(self, index: int) -> StartArrays:
        """One of the scenes."""
        return StartArrays(*(values[index] for values in self))

    def real_scene(self, index: int) -> StartArrays:
        """One of the scenes without the padding at its end."""
        scene = self.scene(index)
        n = count_real(scene.mask)
        return StartArrays(
            scene.cells[:n], scene.velocity[:n], scene.gravity, scene.material[:n], scene.mask[:n], scene.state
        )


def count_real(mask: Array) -> int:
    """Particles of a mask (N,) but the padding at its end; all if there is nothing else."""
    return len(mask) - int(mask[::-1].argmax()) if len(mask) else 0


def rasterise(
    parameters: KernelParameters, position: Array, velocity: Array, gravity: Array, material: Array, mask: Array,
    solid: Array,
) -> StartArrays:  # fmt: skip
    """Particles in grid units and the grid state, as `nmpm.emulator.rasterise.grid_state`; arrays as in `Particles`.

    `material` is (B, 0) where there is only one; `solid` is (B, C_solid, *S).
    """
    cells, moved = np.empty((2, *position.shape), np.float32)
    pull, size = gravity / parameters.box[1], parameters.size
    state = np.empty((len(position), size, parameters.channels), np.float32)
    for b in range(len(position)):
        sums = _sum_particles(parameters, position[b], velocity[b], material[b], mask[b], cells[b], moved[b])
        fill_state(
            sums, position.shape[2], np.float32(parameters.particle_volume),
            solid[b, 0].reshape(-1) if parameters.solid else _NONE, pull[b] if parameters.constants else _NONE,
            state[b],
        )  # fmt: skip
    return StartArrays(cells, moved, pull, material, mask, state)


def _sum_particles(
    parameters: KernelParameters, position: Array, velocity: Array, material: Array, mask: Array, cells: Array,
    moved: Array,
) -> Array:  # fmt: skip
    """Fill in positions and velocities (N, D) of a scene in grid units, and return the sums of `scatter`."""
    (shape, wraps, steps), columns = parameters.p2g_grid, parameters.volume_channels[1]
    real = count_real(mask)
    to_cells(position[real:], velocity[real:], parameters.box, cells[real:], moved[real:])

    def add(low: int, high: int) -> Array:
        sums = np.zeros((parameters.size, columns), np.float32)
        here, speeds = cells[low:high], moved[low:high]
        to_cells(position[low:high], velocity[low:high], parameters.box, here, speeds)
        scatter(speeds, material[low:high], mask[low:high], here, shape, wraps, steps, sums)
        return sums

    parts = map_ranges(add, split(real, max(_CHUNK, 4 * parameters.size)), torch.get_num_threads())
    total = parts[0] if parts else np.zeros((parameters.size, columns), np.float32)
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
def fill_state(sums: Any, width: Any, particle_volume: Any, solid: Any, constants: Any, state: Any) -> Any:
    """Fill in the channels of a grid state: mean values, shares of volume, the solid, the constants.

    From `sums` (size, M V + M) of V = `width` values of each material, then numbers of particles; `solid` (size,),
    empty where there is no such channel; and `constants` (K,), which are the same everywhere.
    """
    materials = sums.shape[1] // (width + 1)
    for node in range(len(sums)):
        for kind in range(materials):
            count = sums[node, materials * width + kind]
            total = count if count > ZERO else ONE
            for k in range(kind * width, (kind + 1) * width):
                state[node, k] = sums[node, k] / total
            state[node, materials * width + kind] = count * particle_volume
        channel = sums.shape[1]
        if len(solid):
            state[node, channel] = solid[node]
            channel += 1
        for k in range(len(constants)):
            state[node, channel + k] = constants[k]


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
    """Fill in the fields, whose channels lie next to each other, from an output (m, C, size) and its scale (m C,)."""
    channels = fields.shape[2]
    for begin in range(0, fields.shape[1], _BLOCK):
        end = min(begin + _BLOCK, fields.shape[1])
        for frame in range(len(fields)):
            for c in range(channels):
                these, field = output[frame, c, begin:end], fields[frame, begin:end]
                factor = scale[frame * channels + c]
                for node in range(len(these)):
                    field[node, c] = these[node] * factor
