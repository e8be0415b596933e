"""CUDA graphs: a whole bundle, network and all around it, recorded once and launched as one.

On a GPU a small scene's bundle is hundreds of kernels of a few microseconds, each launched from Python; a graph
launches them all at once. Shapes are fixed: each batch and number of particles has a graph of its own.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import torch
from torch import Tensor

from nmpm.emulator.engines import ENGINES
from nmpm.emulator.engines.rules import MODELS, lacks
from nmpm.emulator.runtimes.programs import Programs
from nmpm.emulator.runtimes.runtime import Eager, Runtime, refuse_gradients
from nmpm.errors import ConfigError
from nmpm.processors import GridProcessor
from nmpm.transfer.execution import is_default

if TYPE_CHECKING:
    from nmpm.emulator.bundle import Bundle, RolloutContext
    from nmpm.emulator.model import Emulator
    from nmpm.particles import Particles

T = TypeVar("T")

_WARM_UP = 3
"""Calls before a graph is recorded: libraries choose kernels and allocate workspaces in them."""


class CudaGraph(Runtime):
    """Records the bundle of each shape of state in its first call, and replays it from then on."""

    name: ClassVar[str] = "cuda-graph"

    def __init__(self) -> None:
        self._programs: Programs[Recorded] = Programs()

    def unsupported_reason(self, emulator: Emulator) -> str:
        if emulator.device.type != "cuda":
            return f"The runtime cuda-graph needs a CUDA GPU; the model is on {emulator.device}."
        if emulator.constraints.bounds == "error":
            return "The runtime cuda-graph cannot stop at a particle out of bounds: use constraints.bounds stop."
        if emulator.scene.fields:
            return f"The runtime cuda-graph does not carry fields ({', '.join(emulator.scene.fields)}): use eager."
        return ""

    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        return Eager().fields(network, grid, precision)

    def bundle(self, emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
        if reason := self.unsupported_reason(emulator):
            raise ConfigError(reason)
        state = {name: value for name, value in vars(particles).items() if isinstance(value, Tensor)}
        inputs = [*state.values(), context.solid, *([] if context.budget is None else [context.budget])]
        refuse_gradients(self, emulator, *inputs)
        if not is_default() or torch.is_autocast_enabled(emulator.device.type):
            return emulator.predict(particles, context)  # what these choose is not to be recorded

        def predict(copies: Sequence[Tensor]) -> Bundle:
            values: dict[str, Any] = dict(zip(state, copies, strict=False))
            copied = dataclasses.replace(particles, **values)
            budget = None if context.budget is None else copies[-1]
            return self.predict(emulator, copied, dataclasses.replace(context, solid=copies[len(state)], budget=budget))

        shapes = tuple((tensor.shape, tensor.dtype) for tensor in inputs)
        recorded = self._programs.find(emulator, shapes, lambda: Recorded(predict, inputs))
        return recorded(inputs)

    def predict(self, emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
        """The bundle that is recorded."""
        return emulator.predict(particles, context)


class Triton(CudaGraph):
    """Records kernels in Triton around the network; chosen by name alone, as no GPU has confirmed them yet."""

    name: ClassVar[str] = "triton"
    automatic: ClassVar[bool] = False

    def unsupported_reason(self, emulator: Emulator) -> str:
        if emulator.device.type != "cuda":
            return f"The runtime triton needs a CUDA GPU; the model is on {emulator.device}."
        missing = lacks("triton", MODELS, emulator.recipe)
        if emulator.precision != torch.float32:
            missing.append(f"{emulator.precision}")
        if torch.are_deterministic_algorithms_enabled():
            missing.append("deterministic algorithms")
        if missing:
            return f"The runtime triton has no kernels for {', '.join(missing)}: use cuda-graph or eager."
        if importlib.util.find_spec("triton") is None:
            return "The runtime triton needs Triton, which comes with torch's builds for CUDA: pip install triton."
        return ""

    def predict(self, emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
        if particles.volume is not None:
            raise ConfigError(
                "The runtime triton has no kernels for particles of several sizes: use cuda-graph or eager."
            )
        return ENGINES["triton"](emulator).predict(particles, context)


class Recorded:
    """The recording of a function, of tensors on a GPU to a bundle, for copies of inputs."""

    def __init__(self, predict: Callable[[Sequence[Tensor]], Bundle], inputs: Sequence[Tensor]) -> None:
        self._inputs = [tensor.clone(memory_format=torch.contiguous_format) for tensor in inputs]
        with torch.no_grad():
            self._replay, self._bundle = record(lambda: predict(self._inputs), inputs[0].device)

    def __call__(self, inputs: Sequence[Tensor]) -> Bundle:
        """The bundle for inputs of these shapes, in fresh memory."""
        for copied, tensor in zip(self._inputs, inputs, strict=True):
            copied.copy_(tensor)
        self._replay()
        made = self._bundle
        return dataclasses.replace(made, position=made.position.clone(), velocity=made.velocity.clone())


def warn_not_recorded(what: str, failure: Exception) -> None:
    """Warn that something is not recorded, of whatever an operation raises that cannot be."""
    reason = (str(failure).splitlines() or [type(failure).__name__])[0][:200]
    warnings.warn(f"{what} are not recorded as CUDA graphs: {reason}", stacklevel=5)


def record(function: Callable[[], T], device: torch.device, pool: Any = None) -> tuple[Callable[[], None], T]:
    """A launch of the kernels that a function runs on a GPU, and its result, whose tensors each launch overwrites.

    Recordings with the same `pool` of memory overwrite each other's results. Other threads may use the GPU meanwhile.
    """
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.device(device):
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(_WARM_UP):
                function()
        torch.cuda.current_stream().wait_stream(aside)
        try:
            with torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
                result = function()
        except Exception:
            _replace_generator(device)
            raise

    def replay() -> None:
        with torch.cuda.device(device):
            graph.replay()

    return replay, result


def _replace_generator(device: torch.device) -> None:
    """Give a GPU a new state of random numbers: that of a recording that failed waits for its end for ever."""
    fresh = torch.Generator(device).graphsafe_get_state()
    torch.cuda.default_generators[device.index or 0].graphsafe_set_state(fresh)
