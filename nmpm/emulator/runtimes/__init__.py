"""Runtimes: what computes an emulator's network, or whole bundles, in inference. Weights and results stay the same.

A runtime is added by one file and one line here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from nmpm._support.messages import one_line, suggestion
from nmpm.emulator.runtimes.cuda_graph import CudaGraph, Triton
from nmpm.emulator.runtimes.openvino import OpenVINO
from nmpm.emulator.runtimes.runtime import Eager, Runtime
from nmpm.emulator.runtimes.windows import Windows
from nmpm.errors import ConfigError

__all__ = [
    "RUNTIMES",
    "CudaGraph",
    "Eager",
    "OpenVINO",
    "Runtime",
    "Triton",
    "Windows",
    "check_runtime",
    "find_runtime",
]

RUNTIMES: Mapping[str, type[Runtime]] = MappingProxyType(
    {kind.name: kind for kind in (CudaGraph, Triton, OpenVINO, Windows, Eager)}
)
"""Runtimes by name; the last one runs every network everywhere."""


def find_runtime(name: str) -> Runtime:
    """A runtime of `RUNTIMES`, without any program compiled yet; raises ConfigError if there is none of that name."""
    check_runtime(name, list(RUNTIMES))
    return RUNTIMES[name]()


def check_runtime(name: str, names: Sequence[str]) -> None:
    """Check the name of a runtime; raises ConfigError if it is not one of these names, which are listed."""
    if name not in names:
        raise ConfigError(
            f"No runtime is called {one_line(repr(name), 60)}; there are {', '.join(names)}."
            f"{suggestion(name[:60], names)}"
        )
