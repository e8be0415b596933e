"""What computes an emulator's calls here, in a few lines, and why nothing faster does."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

import torch

from nmpm.emulator.engines.rules import CALLS, MODELS, RECORDINGS, RUNTIMES, Call, call_engine, lacks
from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator

_ENGINES: Mapping[str, str] = MappingProxyType(
    {
        "torch": "torch's operations",
        "numba": "Numba kernels",
        "numba training": "Numba kernels with gradients",
        "triton": "Triton kernels",
        "triton training": "Triton kernels with gradients",
    }
)
_FASTEST: Mapping[tuple[str, bool], str] = MappingProxyType(
    {
        ("cpu", False): "numba",
        ("cpu", True): "numba training",
        ("cuda", False): "triton",
        ("cuda", True): "triton training",
    }
)
"""The engine made for a kind of device, and for rollouts or trainings."""


@torch.no_grad()
def explain(emulator: Emulator) -> list[str]:
    """Lines on the engines of rollouts and trainings, the network's runtime, and recordings, where the emulator is."""
    state, precision = _state(emulator), str(emulator.network_precision).removeprefix("torch.")
    openvino = ", ".join(lacks("openvino", RUNTIMES, emulator))
    other = f"openvino does not take {openvino}" if openvino else "`optimized()` tries openvino, too"
    unrecorded = ", ".join(lacks("graph", RECORDINGS, Call(_in_mode(emulator, False), state, emulator.solid(state))))
    recorded = f"no CUDA graphs: {unrecorded}" if unrecorded else "as CUDA graphs, from the second call of a shape on"
    return [
        f"On {emulator.device}:",
        f"  rollouts   {_engine(emulator, state, False)}",
        f"  trainings  {_engine(emulator, state, True)}",
        f"  network    runtime {emulator.runtime.name}, {precision}; {other}",
        f"  recorded   {recorded}",
    ]


def _engine(emulator: Emulator, state: Particles, training: bool) -> str:
    """The engine of rollouts or trainings, and what keeps a faster one from them."""
    form = _in_mode(emulator, training)
    solid = form.solid(state)
    with torch.set_grad_enabled(training):
        name, faster = call_engine(form, state, solid), _FASTEST.get((state.position.device.type, training), "torch")
        missing = [*lacks(faster, MODELS, form.recipe), *lacks(faster, CALLS, Call(form, state, solid))]
    if name.startswith("triton") and (difference := emulator.kernel_trial.difference(form)):
        return f"{_ENGINES['torch']}; Triton kernels are not used: {difference}"
    if name == faster:
        return _ENGINES[name]
    return f"{_ENGINES[name]}; {_ENGINES[faster]} do not take {', '.join(missing)}"


def _in_mode(emulator: Emulator, training: bool) -> Emulator:
    other = copy.copy(emulator)
    other.training = training
    return other


def _state(emulator: Emulator) -> Particles:
    """A particle of the emulator's scene at rest in the domain's middle."""
    scene, device = emulator.scene, emulator.device
    middle = torch.tensor([[[(low + high) / 2 for low, high in scene.bounds]]], device=device)
    none = middle.new_zeros(1, 0, scene.dim)
    present, absent = (torch.ones(1, count, dtype=torch.bool, device=device) for count in (1, 0))
    fields = {name: middle.new_zeros(1, 1) for name in scene.fields}
    material = torch.zeros(1, 1, dtype=torch.long, device=device)
    return Particles(middle, 0 * middle, material, present, none, absent, middle.new_zeros(1, scene.dim), fields)
