"""A comparison of Triton's kernels with torch's operations before they are used on a GPU."""

from __future__ import annotations

import warnings
from collections.abc import Hashable
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks

from nmpm._support.messages import one_line
from nmpm.emulator.bundle import RolloutContext
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.emulator.runtimes import Runtime
from nmpm.processors import GridProcessor

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator
    from nmpm.particles import Particles

TOLERANCE = 1e-3
"""Cells by which positions after one bundle may differ; standard deviations by which the network's inputs may."""
_GRADIENT, _LEAST = 0.01, 1e-12
"""Share of the length of gradients by which they may differ, and what else they may."""
_SHARE = 0.1
"""Share of the particles that may differ by more with constraints, whose thresholds amplify rounding."""


class KernelTrial:
    """Compares one bundle by each engine in an emulator's first call, for each device, constraints and trainings.

    Copies and unpickled instances compare anew.
    """

    def __init__(self) -> None:
        self._results: dict[Hashable, str] = {}

    def __reduce__(self) -> tuple[type[KernelTrial], tuple[()]]:
        return type(self), ()

    def passes(self, emulator: Emulator, particles: Particles, solid: Tensor) -> bool:
        """Whether the kernels give what torch gives, for states like this one. If not, a warning has said so once."""
        key = particles.position.device, emulator.constraints, emulator.training
        if key not in self._results:
            self._results[key] = difference = _difference(emulator, particles, solid)
            if difference:
                message = f"Kernels in Triton are not used on {key[0]}, but torch's operations: {difference}."
                warnings.warn(message, stacklevel=2)
        return not self._results[key]

    def difference(self, emulator: Emulator) -> str:
        """What differs on the emulator's device, if that has been tried; empty for nothing."""
        return self._results.get((emulator.device, emulator.constraints, emulator.training), "")


@torch.no_grad()
def _difference(emulator: Emulator, particles: Particles, solid: Tensor) -> str:
    """What differs between a bundle by Triton and by torch; empty for nothing."""
    compare = _training_difference if emulator.training else _rollout_difference
    try:
        return compare(emulator, particles, RolloutContext(solid, emulator.budget(particles)))
    except Exception as failure:  # (of whatever compilers and drivers raise)
        return f"they fail here ({type(failure).__name__}: {one_line(str(failure), 200)})"


def _rollout_difference(emulator: Emulator, particles: Particles, context: RolloutContext) -> str:
    inputs, free = _apart(emulator.unconstrained(), particles, context)
    _, constrained = _apart(emulator, particles, context)
    if not inputs <= TOLERANCE:
        return f"the network's inputs differ by {inputs:.2g} standard deviations on average"
    if difference := _path_difference(free):
        return difference
    if (share := float((~(constrained <= TOLERANCE)).float().mean())) > _SHARE:
        return f"with constraints {share:.0%} of the particles differ by more than {TOLERANCE} cells after one bundle"
    return ""


def _path_difference(cells: Tensor) -> str:
    """What is wrong with distances (P,) of particles without constraints."""
    if not (most := max(cells.tolist(), default=0.0)) <= TOLERANCE or bool(cells.isnan().any()):
        return f"positions after one bundle differ by {most:.2g} cells, where {TOLERANCE} are expected"
    return ""


def _training_difference(emulator: Emulator, particles: Particles, context: RolloutContext) -> str:
    from nmpm.emulator.engines.triton.training import TritonTraining

    engines = TorchEngine(emulator), TritonTraining(emulator)
    velocities = engines[0].rasterise(particles, context).state[:, : emulator.scene.dim * len(emulator.scene.materials)]
    output = velocities.unsqueeze(1).repeat(1, emulator.frames, *(1,) * (velocities.dim() - 1))
    (path, gradients), (other, others) = (_differentiate(engine, particles, output, context) for engine in engines)
    if difference := _path_difference((path - other).norm(dim=-1).amax(1)[particles.mask]):
        return difference
    for name, here, there in zip(("positions", "velocities", "outputs"), gradients, others, strict=True):
        if not (apart := float((here - there).norm())) <= _GRADIENT * float(here.norm()) + _LEAST:
            return f"gradients of {name} differ by {apart:.2g}, of {float(here.norm()):.2g}"
    return ""


def _differentiate(
    engine: TorchEngine, particles: Particles, output: Tensor, context: RolloutContext
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """(B, m, N, D) positions in cells by a network's output, and gradients with respect to motion and output."""
    # A checkpoint around this call must not count what is kept here.
    with torch.enable_grad(), saved_tensors_hooks(lambda kept: kept, lambda kept: kept):
        leaves = [each.detach().clone().requires_grad_() for each in (particles.position, particles.velocity, output)]
        start = engine.rasterise(particles.with_motion(*leaves[:2]), context)
        path = engine.path(start, leaves[2], context)
        value = path.where(particles.mask[:, None, :, None], 0.0).square().mean()
        value = value + start.filled(len(engine.emulator.scene.materials)).square().mean()
        return path.detach(), torch.autograd.grad(value, leaves, materialize_grads=True)


def _apart(emulator: Emulator, particles: Particles, context: RolloutContext) -> tuple[float, Tensor]:
    """How far the network's inputs are apart on average, and (P,) particles in cells, by the same network output."""
    from nmpm.emulator.engines.triton.engine import TritonEngine  # Triton comes with torch's builds for CUDA

    output = _SharedOutput(emulator.runtime)
    sharing = emulator.with_runtime(output)
    engines = TorchEngine(sharing), TritonEngine(sharing)
    here, there = (engine.predict(particles, context).position for engine in engines)
    one, other = output.inputs
    cells = (here - there).norm(dim=-1).amax(1) / min(emulator.grid.spacing)
    return float((one - other).abs().mean()), cells[particles.mask]


class _SharedOutput(Runtime):
    """A network's output for its first input, given for each further one."""

    name = "shared output"

    def __init__(self, runtime: Runtime) -> None:
        self._runtime, self.inputs = runtime, list[Tensor]()

    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        if not self.inputs:
            self._output = self._runtime.fields(network, grid, precision)
        self.inputs.append(grid)
        return self._output
