"""The stress battery: a trained emulator at the extremes, one result of pass or fail for each. Imports no torch.

What the groups of tests share is `model.py`, `trace.py` and `results.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from nmpm.registry import Registry

if TYPE_CHECKING:
    from nmpm.evaluation.stress.results import TestResult

_ROOM = "nmpm.evaluation.stress"
GROUPS: Registry[Callable[..., Iterator[TestResult]]] = Registry(
    "nmpm.stress",
    "group of stress tests",
    {
        "long": f"{_ROOM}.long:duration",
        "settling": f"{_ROOM}.long:settling",
        "speeds": f"{_ROOM}.scenes:speeds",
        "counts": f"{_ROOM}.scenes:counts",
        "sizes": f"{_ROOM}.scenes:sizes",
        "precision": f"{_ROOM}.numerics:precision",
        "sensitivity": f"{_ROOM}.numerics:sensitivity",
        "obstacles": f"{_ROOM}.obstacles:obstacles",
        "poison": f"{_ROOM}.numerics:poison",
        "free": f"{_ROOM}.unconstrained:network_alone",
    },
)
"""Each a function of a `ModelUnderTest` and an `Effort`."""
