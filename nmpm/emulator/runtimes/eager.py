"""Torch itself, operation by operation: for every network, device and precision, and with gradients."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nmpm.emulator.runtimes.base import Runtime
from nmpm.processors import GridProcessor


class Eager(Runtime):
    """Calls the network."""

    name: ClassVar[str] = "eager"
    fixed_shapes: ClassVar[bool] = False

    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        out: Tensor = network(grid.to(precision))
        return out
