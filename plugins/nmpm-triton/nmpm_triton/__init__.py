"""An engine of nmpm: steps of a call on a CUDA GPU as kernels in Triton.

`grid` has the kernels from particles to grid, `motion` those that move particles, `contact`, `rest` and `crowding`
those that change paths; `engine` launches them in rollouts. `adjoint` has gradients, for `training`. `launch` says how.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nmpm.emulator.engines.engine import Engine, EngineForm

if TYPE_CHECKING:
    from nmpm.emulator import Emulator


def _for_rollouts(emulator: Emulator) -> Engine[Any, Any]:
    from nmpm_triton.engine import TritonEngine  # imported late, as Triton is

    return TritonEngine(emulator)


def _for_trainings(emulator: Emulator) -> Engine[Any, Any]:
    from nmpm_triton.training import TritonTraining

    return TritonTraining(emulator)


_BOTH = frozenset({"a CUDA GPU", "sizes of particles", "several sizes in a scene"})
_OF_TRAININGS = {"trainings", "gradients of a rollout", "a recorded training step, which moves its grid"}
FORMS = (
    EngineForm("triton", "Triton kernels", _BOTH | {"rollouts"}, _for_rollouts),
    EngineForm("triton training", "Triton kernels with gradients", _BOTH | _OF_TRAININGS, _for_trainings),
)
