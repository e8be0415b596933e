"""The emulator: its recipe, the network between p2g and g2p, what its rollouts are held to, and rollouts themselves."""

from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.model import NETWORK_PRECISIONS, Emulator
from nmpm.emulator.prescribed import Prescribed
from nmpm.emulator.recipe import EmulatorRecipe
from nmpm.emulator.rollouts import (
    Rollout,
    RolloutOptions,
    differentiable_rollout,
    predict_rollout,
    rollout,
    stream_rollout,
    unroll,
)
from nmpm.emulator.runtimes import Windows

__all__ = [
    "NETWORK_PRECISIONS",
    "Bundle",
    "Emulator",
    "EmulatorRecipe",
    "Prescribed",
    "Rollout",
    "RolloutContext",
    "RolloutOptions",
    "Windows",
    "differentiable_rollout",
    "predict_rollout",
    "rollout",
    "stream_rollout",
    "unroll",
]
