"""Engines: what computes an emulator's calls, but for the network. `rules` says which of them takes a call."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from torch import Tensor

from nmpm.emulator.engines.engine import Engine
from nmpm.emulator.engines.rules import call_engine
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator


def find_engine(emulator: Emulator, particles: Particles, solid: Tensor) -> Engine[Any, Any]:
    """The engine that computes a call, of a state among solids (B, C_solid, *S)."""
    name = call_engine(emulator, particles, solid)
    if name.startswith("triton") and not emulator.kernel_trial.passes(emulator, particles, solid):
        name = "torch"
    return ENGINES[name](emulator)


def _numba(emulator: Emulator) -> Engine[Any, Any]:
    from nmpm.emulator.engines.numba.engine import NumbaEngine  # imported late, as Numba is

    return NumbaEngine(emulator)


def _numba_training(emulator: Emulator) -> Engine[Any, Any]:
    from nmpm.emulator.engines.numba.training import NumbaTraining

    return NumbaTraining(emulator)


def _triton(emulator: Emulator) -> Engine[Any, Any]:
    from nmpm.emulator.engines.triton.engine import TritonEngine  # Triton comes with torch's builds for CUDA

    return TritonEngine(emulator)


def _triton_training(emulator: Emulator) -> Engine[Any, Any]:
    from nmpm.emulator.engines.triton.training import TritonTraining

    return TritonTraining(emulator)


ENGINES: Mapping[str, Callable[[Emulator], Engine[Any, Any]]] = MappingProxyType(
    {
        "torch": TorchEngine,
        "numba": _numba,
        "numba training": _numba_training,
        "triton": _triton,
        "triton training": _triton_training,
    }
)
"""How engines are made for an emulator, by name."""
