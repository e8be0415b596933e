"""The contract of runtimes, and that of torch itself, which takes every network, device and precision.

Programs compiled from networks, kept for the shapes and settings used last.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from threading import RLock
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar

import torch
from torch import Tensor, nn

from nmpm._support.machine import computes_bfloat16
from nmpm.errors import ConfigError
from nmpm.processors import GridProcessor

if TYPE_CHECKING:
    from nmpm.emulator.bundle import Bundle, RolloutContext
    from nmpm.emulator.model import Emulator
    from nmpm.particles import Particles


class Runtime(ABC):
    """Computes an emulator's network.

    Weights stay in the emulator. An instance may keep programs compiled from them; copies and unpickled instances start
    without, so that copied emulators, on other devices or with other weights, compile their own.
    """

    name: ClassVar[str]
    fixed_shapes: ClassVar[bool] = True
    """Whether another shape of the state or of the grid costs a compilation."""
    automatic: ClassVar[bool] = True
    """Whether it may be the fastest in any scene; others are tried where times are measured in a given scene."""

    recordable: ClassVar[bool] = False
    """Whether CUDA graphs can hold calls in which it computes the network."""

    def unsupported_reason(self, emulator: Emulator) -> str:  # noqa: ARG002 (none unless overridden)
        """The feature of the emulator that this runtime does not run here, with the mend; empty for none."""
        return ""

    @abstractmethod
    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        """The network's output (B, m, C_out, *S), in a precision, for a normalised grid state (B, C_in, *S).

        Raises ConfigError if this runtime cannot run the network, or gradients are asked for that it does not have.
        """

    def bundle(self, emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
        """The bundle that the emulator predicts, see `Emulator.predict`; overridden to plan by the particles."""
        return emulator.predict(particles, context)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return type(self)()

    def __reduce__(self) -> tuple[type[Self], tuple[()]]:
        return type(self), ()


class Eager(Runtime):
    """Calls the network."""

    name: ClassVar[str] = "eager"
    fixed_shapes: ClassVar[bool] = False
    recordable: ClassVar[bool] = True

    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        if precision == torch.bfloat16 and not computes_bfloat16(grid.device):
            warnings.warn(
                "This processor has no instructions for bfloat16: torch is slower in it than in float32.",
                stacklevel=2,
            )
        out: Tensor = network(grid.to(precision))
        return out


def refuse_gradients(runtime: Runtime, network: nn.Module, *inputs: Tensor) -> None:
    """Raise ConfigError for networks in training mode, or if gradients are on and an input or a weight requires one."""
    tracked = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (*inputs, *network.parameters()))
    if network.training or tracked:
        raise ConfigError(
            f"The runtime {runtime.name} has no gradients: train, or differentiate rollouts, with the model as loaded,"
            ' without `optimized`, or with `emulator.with_runtime("eager")`; for inference call `eval()` and'
            " `requires_grad_(False)`."
        )


P = TypeVar("P")

MOST = 8
"""Programs kept by one runtime: batches and grids of one use differ little."""


@dataclass(frozen=True)
class _Weight:
    """A tensor of a module whose values a program holds.

    Args:
        store, name: Where the module keeps it.
        tensor: What that was when the program was made.
        alias: Keeps the memory, so that no other tensor gets its address.
        address, version: Of the tensor then; writing to it changes the version, replacing its memory the address. Those
            made in inference mode have no version.
    """

    store: Mapping[str, Tensor | None]
    name: str
    tensor: Tensor
    alias: Tensor
    address: int
    version: int | None


@dataclass(frozen=True)
class _Compiled(Generic[P]):
    """A program, with the module it was compiled from and the tensors whose values it holds."""

    network: nn.Module
    weights: list[_Weight]
    program: P

    def is_current(self) -> bool:
        """Whether the module has the same weights, unchanged: asked in each call, hence a loop without calls."""
        for weight in self.weights:
            tensor = weight.tensor
            if weight.store.get(weight.name) is not tensor or tensor.data_ptr() != weight.address:
                return False
            if weight.version is not None and tensor._version != weight.version:
                return False
        return True


def _weights(network: nn.Module) -> list[_Weight]:
    stores = (store for module in network.modules() for store in (module._parameters, module._buffers))
    return [
        _Weight(
            store, name, tensor, tensor.detach(), tensor.data_ptr(), None if tensor.is_inference() else tensor._version
        )
        for store in stores
        for name, tensor in store.items()
        if tensor is not None
    ]


class Programs(Generic[P]):
    """The programs of one runtime; one whose weights have changed since is compiled again."""

    def __init__(self) -> None:
        self._compiled: OrderedDict[tuple[int, Hashable], _Compiled[P]] = OrderedDict()
        self._lock = RLock()

    def get(self, network: nn.Module, settings: Hashable) -> P | None:
        """The program of a module for settings; None if there is none of its present weights."""
        key = id(network), settings
        with self._lock:
            compiled = self._compiled.get(key)
            if compiled is None or not compiled.is_current():
                return None
            self._compiled.move_to_end(key)
            return compiled.program

    def find(self, network: nn.Module, settings: Hashable, compile_program: Callable[[], P]) -> P:
        """The program of a module for settings, all else that it depends on; compiled if there is none."""
        with self._lock:
            program = self.get(network, settings)
            if program is None:
                weights, program = _weights(network), compile_program()
                self._compiled[id(network), settings] = _Compiled(network, weights, program)
                self._compiled.move_to_end((id(network), settings))
                while len(self._compiled) > MOST:
                    self._compiled.popitem(last=False)
            return program
