"""Torch itself, operation by operation: for every network, device and precision, and with gradients."""

from __future__ import annotations

import warnings
from typing import ClassVar

import torch
from torch import Tensor

from nmpm._support.devices import computes_bfloat16
from nmpm.emulator.runtimes.base import Runtime
from nmpm.processors import GridProcessor


class Eager(Runtime):
    """Calls the network."""

    name: ClassVar[str] = "eager"
    fixed_shapes: ClassVar[bool] = False

    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        if precision == torch.bfloat16 and not computes_bfloat16(grid.device):
            warnings.warn(
                "This processor has no instructions for bfloat16: torch is slower in it than in float32.",
                stacklevel=2,
            )
        out: Tensor = network(grid.to(precision))
        return out
