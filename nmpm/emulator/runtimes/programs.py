"""Programs compiled from networks, kept for the shapes and settings used last."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from threading import Lock
from typing import Generic, TypeVar

from torch import Tensor, nn

P = TypeVar("P")

_MOST = 8
"""Programs kept by one runtime: batches and grids of one use differ little."""


@dataclass(frozen=True)
class _Compiled(Generic[P]):
    """A program, with the module it was compiled from and the tensors whose values it holds."""

    network: nn.Module
    modules: list[nn.Module]
    weights: list[Tensor]
    versions: list[int]
    program: P

    def is_current(self) -> bool:
        """Whether the module still has these tensors, unchanged."""
        now = _tensors(self.modules)
        same = len(now) == len(self.weights) and all(
            one.data_ptr() == other.data_ptr() for one, other in zip(now, self.weights, strict=True)
        )
        return same and [tensor._version for tensor in now] == self.versions


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
                modules = list(network.modules())
                # Aliases, so that the memory of tensors that the network gives up is not mistaken for theirs.
                weights = [tensor.detach() for tensor in _tensors(modules)]
                versions = [tensor._version for tensor in weights]
                found = _Compiled(network, modules, weights, versions, compile_program())
                self._known[key] = found
            self._known.move_to_end(key)
            while len(self._known) > _MOST:
                self._known.popitem(last=False)
            return found.program


def _tensors(modules: list[nn.Module]) -> list[Tensor]:
    """Parameters and buffers of modules, faster than `Module.parameters`, which walks the tree each time."""
    both = (each for module in modules for each in (module._parameters, module._buffers))
    return [tensor for named in both for tensor in named.values() if tensor is not None]
