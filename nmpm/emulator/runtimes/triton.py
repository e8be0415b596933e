"""Kernels in Triton around the network, in a CUDA graph; chosen by name alone, as no GPU has confirmed them yet."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from nmpm.emulator.prediction import predict_bundle
from nmpm.emulator.runtimes.cuda_graph import CudaGraph
from nmpm.errors import ConfigError
from nmpm.transfer import Linear

if TYPE_CHECKING:
    from nmpm.emulator.bundle import Bundle, RolloutContext
    from nmpm.emulator.model import Emulator
    from nmpm.particles import Particles


class Triton(CudaGraph):
    """Records the kernels of `nmpm.emulator.gpu` and the network's, for each shape of state in its first call."""

    name: ClassVar[str] = "triton"
    automatic: ClassVar[bool] = False

    def unsupported_reason(self, emulator: Emulator) -> str:
        scene, bounds = emulator.scene, emulator.constraints.bounds
        rules = {
            f"{scene.dim} dimensions": scene.dim != 2,
            f"fields ({', '.join(scene.fields)})": bool(scene.fields),
            f"the transfer {type(emulator.transfer).__name__}": type(emulator.transfer) is not Linear,
            f"constraints.bounds {bounds}": bounds != "stop",
            f"the decoder {type(emulator.decoder).__name__}, or for bounds so far off": emulator._plan is None,
            f"{emulator.precision}": emulator.precision != torch.float32,
            "deterministic algorithms": torch.are_deterministic_algorithms_enabled(),
        }
        if emulator.device.type != "cuda":
            return f"The runtime triton needs a CUDA GPU; the model is on {emulator.device}."
        for reason, holds in rules.items():
            if holds:
                return f"The runtime triton has no kernels for {reason}: use cuda-graph or eager."
        if importlib.util.find_spec("triton") is None:
            return "The runtime triton needs Triton, which comes with torch's builds for CUDA: pip install triton."
        return ""

    def predict(self, emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
        from nmpm.emulator.gpu.steps import TritonSteps

        if emulator._plan is None:
            raise ConfigError(self.unsupported_reason(emulator))
        return predict_bundle(
            emulator, TritonSteps(emulator, emulator._plan), particles.map(Tensor.contiguous), context
        )
