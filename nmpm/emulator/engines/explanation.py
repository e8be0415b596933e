"""What computes an emulator's calls here, in a few lines, and why nothing faster does."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import torch

from nmpm.backends import ENGINES
from nmpm.emulator.engines.rules import CALLS, MODELS, NETWORKS, RECORDINGS, Call, lacks
from nmpm.emulator.runtimes.openvino import OpenVINO
from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.engines.engine import EngineForm
    from nmpm.emulator.model import Emulator


@torch.no_grad()
def explain(emulator: Emulator) -> list[str]:
    """Lines on the engines of rollouts and trainings, the network's runtime, and recordings, where the emulator is."""
    state, precision = _state(emulator), str(emulator.network_precision).removeprefix("torch.")
    openvino = ", ".join(lacks(NETWORKS, emulator, OpenVINO.features))
    other = f"openvino does not take {openvino}" if openvino else "`optimized()` tries openvino, too"
    unrecorded = ", ".join(lacks(RECORDINGS, Call(_in_mode(emulator, False), state, emulator.solid(state))))
    recorded = f"no CUDA graphs: {unrecorded}" if unrecorded else "as CUDA graphs, from the second call of a shape on"
    lines = [
        f"On {emulator.device}:",
        f"  rollouts   {_engine(emulator, False)}",
        f"  trainings  {_engine(emulator, True)}",
        f"  network    runtime {emulator.runtime.name}, {precision}; {other}",
        f"  recorded   {recorded}",
    ]
    installed = [f'`optimized("{name}")`' for name in ENGINES.plugins if name != emulator.engine]
    return lines + ([f"  further    {', '.join(installed)}, of other packages"] if installed else [])


def missing_features(emulator: Emulator, form: EngineForm, training: bool) -> list[str]:
    """What a form of an engine would not take of the rollouts or trainings of an emulator, where that is."""
    mode, state = _in_mode(emulator, training), _state(emulator)
    with torch.set_grad_enabled(training):
        call = Call(mode, state, mode.solid(state))
        return [*lacks(MODELS, emulator.recipe, form.features), *lacks(CALLS, call, form.features)]


def _engine(emulator: Emulator, training: bool) -> str:
    """The engine of rollouts or trainings, and what keeps the emulator's own from them."""
    kind = "trainings" if training else "rollouts"
    form = next((form for form in ENGINES[emulator.engine] if kind in form.features), None)
    if form is None:
        return "torch's operations"
    missing = missing_features(emulator, form, training)
    return f"torch's operations; {form.title} do not take {', '.join(missing)}" if missing else form.title


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
