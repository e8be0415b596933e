"""Which precisions, runtimes and batches of models a sweep measures, and which of them a device has."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal

import torch

from nmpm._support.devices import computes_bfloat16
from nmpm._support.messages import install

Precision = Literal["float32", "bfloat16"]
EAGER, OPENVINO = "eager", "openvino"


@dataclass(frozen=True)
class ModelSettings:
    """Settings of every model; all combinations of them are measured.

    Args:
        precision: Precisions of the network; bfloat16 is left out on processors that emulate it, unless it is the only
            one.
        constraints: "held", with the model's constraints, and "free", without them.
        runtime: What computes the network, see `nmpm.emulator.runtimes.RUNTIMES`; None for torch and, on a CPU,
            OpenVINO if it is installed.
        batch: Batch sizes, in scenes.
        members: Rollouts of each scene by a model's first form, which stand beside it as an ensemble; 0 for none.
    """

    precision: tuple[Precision, ...] = ("float32", "bfloat16")
    constraints: tuple[Literal["held", "free"], ...] = ("held", "free")
    runtime: tuple[str, ...] | None = None
    batch: tuple[int, ...] = (1, 8)
    members: int = 0

    def precisions(self, device: torch.device) -> tuple[Precision, ...]:
        """Those that a device does not emulate; all if it emulates all."""
        computed = tuple(name for name in self.precision if name != "bfloat16" or computes_bfloat16(device))
        return computed or self.precision

    def runtimes(self, device: torch.device) -> tuple[str, ...]:
        """Names of those that are stated, or else installed."""
        if self.runtime is not None:
            return self.runtime
        return (EAGER, OPENVINO) if device.type == "cpu" and find_spec(OPENVINO) else (EAGER,)

    def left_out(self, device: torch.device) -> list[str]:
        """What is not measured on a device, in sentences."""
        lines = []
        if self.precisions(device) != self.precision:
            lines.append("bfloat16 is left out: this processor emulates it, which takes longer than float32.")
        if self.runtime is None and device.type == "cpu" and self.runtimes(device) == (EAGER,):
            lines.append(f"OpenVINO, often the faster runtime, is left out: {install('openvino')} adds it.")
        return lines
