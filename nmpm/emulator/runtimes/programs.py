"""Programs compiled from networks, kept for the shapes and settings used last."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from threading import Lock
from typing import Generic, Self, TypeVar

from torch import Tensor, nn

P = TypeVar("P")

_MOST = 8
"""Programs kept by one runtime: batches and grids of one use differ little."""


@dataclass(frozen=True)
class _Held:
    """A tensor of a module whose values a program holds.

    Args:
        store: Of the module, by name.
        name, tensor: What it had then.
        alias: Keeps the memory, so that no other tensor gets its address.
        address, version: Of the tensor then; writing to it changes the version, replacing its memory the address.
    """

    store: Mapping[str, Tensor | None]
    name: str
    tensor: Tensor
    alias: Tensor
    address: int
    version: int

    @classmethod
    def all_of(cls, network: nn.Module) -> list[Self]:
        """Parameters and buffers of a module and its parts."""
        stores = (store for module in network.modules() for store in (module._parameters, module._buffers))
        return [
            cls(store, name, tensor, tensor.detach(), tensor.data_ptr(), tensor._version)
            for store in stores
            for name, tensor in store.items()
            if tensor is not None
        ]


@dataclass(frozen=True)
class _Compiled(Generic[P]):
    """A program, with the module it was compiled from and the tensors whose values it holds."""

    network: nn.Module
    tensors: list[_Held]
    program: P

    def is_current(self) -> bool:
        """Whether the module still has these tensors, unchanged. In each call, so in few operations."""
        for held in self.tensors:
            tensor = held.tensor
            if held.store.get(held.name) is not tensor or tensor._version != held.version:
                return False
            if tensor.data_ptr() != held.address:
                return False
        return True


class Programs(Generic[P]):
    """The programs of one runtime; one whose weights have changed since is compiled again."""

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[int, Hashable], _Compiled[P]] = OrderedDict()
        self._lock = Lock()

    def find(self, network: nn.Module, settings: Hashable, compile_program: Callable[[], P]) -> P:
        """The program of a module for some settings.

        Args:
            network: Holds the weights.
            settings: All else that the program depends on, such as the shape of its input.
            compile_program: Makes it if there is none.
        """
        key = id(network), settings
        with self._lock:
            found = self._known.get(key)
            if found is None or not found.is_current():
                found = self._known[key] = _Compiled(network, _Held.all_of(network), compile_program())
            self._known.move_to_end(key)
            while len(self._known) > _MOST:
                self._known.popitem(last=False)
            return found.program
