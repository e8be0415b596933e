"""The emulator: its recipe, the network between p2g and g2p, what its rollouts are held to, and rollouts themselves."""

from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.gradients import differentiable_rollout
from nmpm.emulator.model import Emulator
from nmpm.emulator.recipe import EmulatorRecipe
from nmpm.emulator.rollouts import rollout, stream, unroll
from nmpm.emulator.windows import Windows

__all__ = [
    "Bundle",
    "Emulator",
    "EmulatorRecipe",
    "RolloutContext",
    "Windows",
    "differentiable_rollout",
    "rollout",
    "stream",
    "unroll",
]
