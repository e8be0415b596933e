"""Runtimes: what computes an emulator's network in inference. Weights and results stay the same.

A runtime is added by one file and one line here. What computes the rest of a call are `nmpm.emulator.engines`.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from nmpm._support.messages import one_line, suggestion
from nmpm.emulator.runtimes.openvino import OpenVINO
from nmpm.emulator.runtimes.runtime import Eager, Runtime
from nmpm.emulator.runtimes.windows import Windows
from nmpm.errors import ConfigError

__all__ = [
    "RUNTIMES",
    "Eager",
    "OpenVINO",
    "Runtime",
    "Windows",
    "check_runtime",
    "find_runtime",
]

RUNTIMES: Mapping[str, type[Runtime]] = MappingProxyType({kind.name: kind for kind in (OpenVINO, Windows, Eager)})
"""Runtimes by name; the last one runs every network everywhere."""
FORMER: Mapping[str, str] = MappingProxyType(
    {
        "cuda-graph": "on a CUDA GPU calls are recorded as CUDA graphs",
        "triton": "on a CUDA GPU with Triton its kernels are used",
    }
)
"""Former names of runtimes, and what is done without being asked instead."""


def find_runtime(name: str) -> Runtime:
    """A runtime of `RUNTIMES`, without any program compiled yet; "eager", with a warning, for a name of `FORMER`.

    Raises ConfigError if there is none of that name.
    """
    check_runtime(name, list(RUNTIMES))
    if name in FORMER:
        warnings.warn(f"The runtime {name} is now part of eager, the default: {FORMER[name]}.", stacklevel=3)
        return Eager()
    return RUNTIMES[name]()


def check_runtime(name: str, names: Sequence[str]) -> None:
    """Check the name of a runtime; raises ConfigError, with these names, if it is not among them or `FORMER`."""
    if name not in names and name not in FORMER:
        raise ConfigError(
            f"No runtime is called {one_line(repr(name), 60)}; there are {', '.join(names)}."
            f"{suggestion(name[:60], names)}"
        )
