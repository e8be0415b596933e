"""Programs compiled from networks, kept for the shapes and settings used last."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from threading import RLock
from typing import Generic, TypeVar

from torch import Tensor, nn

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
