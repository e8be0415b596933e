"""Engines and runtimes by name: an engine computes an emulator's calls, a runtime the network within them.

Needs no torch, so that help and refusals need not wait for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from nmpm._support.messages import one_line, suggestion
from nmpm.errors import ConfigError
from nmpm.registry import Registry

if TYPE_CHECKING:
    from nmpm.emulator.engines.engine import EngineForm
    from nmpm.emulator.runtimes.runtime import Runtime

ENGINES: Registry[tuple[EngineForm, ...]] = Registry(
    "nmpm.engines",
    "engine",
    {"torch": "nmpm.emulator.engines.torch:FORMS", "numba": "nmpm.emulator.engines.numba:FORMS"},
)
"""The forms of engines by name, such as one for rollouts and one for trainings; what they do not take is torch's."""

RUNTIMES: Registry[type[Runtime]] = Registry(
    "nmpm.runtimes",
    "runtime",
    {
        "openvino": "nmpm.emulator.runtimes.openvino:OpenVINO",
        "windows": "nmpm.emulator.runtimes.windows:Windows",
        "eager": "nmpm.emulator.runtimes.runtime:Eager",
    },
)
"""Runtimes by name; "eager" runs every network everywhere."""

FORMER: Mapping[str, str] = MappingProxyType({"cuda-graph": "on a CUDA GPU calls are recorded as CUDA graphs"})
"""Former names of runtimes, and what "eager" does in their place without being asked."""

AUTO = "auto"
"""Stands for the fastest of `RUNTIMES` that can run a model here, as measured."""


def check_runtime(name: str) -> None:
    """Raise ConfigError, with the names that there are, for a `--runtime` that is no runtime or engine."""
    known = (AUTO, *RUNTIMES, *ENGINES)
    if name not in known and name not in FORMER:
        raise ConfigError(
            f"No runtime is called {one_line(repr(name), 60)}; there are {', '.join(known)}."
            f"{suggestion(name[:60], known)}"
        )
