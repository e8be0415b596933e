"""Engines: what computes an emulator's calls, but for the network. `nmpm.backends.ENGINES` has them by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from nmpm.emulator.engines.engine import Engine
from nmpm.emulator.engines.rules import call_form
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator


def find_engine(emulator: Emulator, particles: Particles, solid: Tensor) -> Engine[Any, Any]:
    """The engine that computes a call, of a state among solids (B, C_solid, *S)."""
    form = call_form(emulator, particles, solid)
    return TorchEngine(emulator) if form is None else form.make(emulator)
