"""Runtimes: what computes an emulator's network in inference. Weights and results stay the same.

`nmpm.backends.RUNTIMES` has them by name. What computes the rest of a call are `nmpm.emulator.engines`.
"""

from __future__ import annotations

import warnings

from nmpm.backends import FORMER, RUNTIMES
from nmpm.emulator.runtimes.openvino import OpenVINO
from nmpm.emulator.runtimes.runtime import Eager, Runtime
from nmpm.emulator.runtimes.windows import Windows

__all__ = ["Eager", "OpenVINO", "Runtime", "Windows", "find_runtime"]


def find_runtime(name: str) -> Runtime:
    """A runtime of `RUNTIMES`, without any program compiled yet; "eager", with a warning, for a name of `FORMER`.

    Raises ConfigError if there is none of that name.
    """
    if name in FORMER:
        warnings.warn(f"The runtime {name} is now part of eager, the default: {FORMER[name]}.", stacklevel=3)
        return Eager()
    return RUNTIMES[name]()
