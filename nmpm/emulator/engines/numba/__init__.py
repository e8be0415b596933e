"""The steps around the network as Numba kernels on a CPU: rollouts (`engine`), trainings with gradients (`training`).

They give what the torch engine gives, to rounding, in a tenth of the time; `nmpm.emulator.engines.rules` says for which
models and calls. `with nmpm.transfer.without_kernels():` chooses the torch engine everywhere.

Kernels take the arrays of one scene, C-contiguous and of float32 unless said otherwise, in cells and cells per frame:

    path              (m + 1, N, D) positions at the bundle's start and in each frame
    velocity          (N, D) velocities at the start
    material          (N,) int64; empty where there is only one
    mask              (N,) bool, False for padding
    mass              (N,) each particle's share of the scene's mass, 0 for padding
    gravity           (D,) what a frame adds to a velocity
    state             (size, C_in) the grid state: velocities, volume fractions, solid, constants
    fields            (m, size, C) velocities that the network predicts, C = materials * D
    rates             (m, size, C) rates of the particles' evolving fields, C = materials * E
    volume            (N,) volume of each particle as a multiple of the scene's; empty where they have that
    obstacle          (size,) share of each cell's room that is obstacle; empty where there are no obstacles
    grid              tuple (shape, wraps, steps) of the cells along each axis, whether it is periodic, and a tuple as
                      long as the transfer has nodes along an axis
    bounds            (3, D) lowest and highest positions, infinite on periodic axes; 1 in the last row to reflect
    ratio             (D,) widths of the cells over that of the first axis
    low, high         the range of particles that the call treats, so that threads share a scene
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nmpm.emulator.engines.engine import Engine, EngineForm

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator


def _for_rollouts(emulator: Emulator) -> Engine[Any, Any]:
    from nmpm.emulator.engines.numba.engine import NumbaEngine  # imported late, as Numba is

    return NumbaEngine(emulator)


def _for_trainings(emulator: Emulator) -> Engine[Any, Any]:
    from nmpm.emulator.engines.numba.training import NumbaTraining

    return NumbaTraining(emulator)


_BOTH = frozenset(
    {
        "fields", "obstacles that move", "a CPU", "moving obstacles in the state", "sizes of particles",
        "deterministic algorithms",
    }
)  # fmt: skip
FORMS = (
    EngineForm(
        "numba",
        "Numba kernels",
        _BOTH
        | {
            "three dimensions", "the transfers Nearest and Quadratic", "bounds: reflect", "rollouts",
            "several sizes in a scene",
        },
        _for_rollouts,
    ),
    EngineForm(
        "numba training",
        "Numba kernels with gradients",
        _BOTH | {"trainings", "gradients of a rollout"},
        _for_trainings,
    ),
)  # fmt: skip
