"""All groups of tests, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType

import torch

from nmpm.evaluation.stress.counts import counts
from nmpm.evaluation.stress.duration import duration
from nmpm.evaluation.stress.free import free
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.obstacles import obstacles
from nmpm.evaluation.stress.poison import poison
from nmpm.evaluation.stress.precision import precision, sensitivity
from nmpm.evaluation.stress.settling import settling
from nmpm.evaluation.stress.sizes import sizes
from nmpm.evaluation.stress.speeds import speeds
from nmpm.evaluation.stress.subject import Subject

Group = Callable[[Subject, Size], Iterator[Line]]

GROUPS: Mapping[str, Group] = MappingProxyType(
    {
        "long": duration,
        "settling": settling,
        "speeds": speeds,
        "counts": counts,
        "sizes": sizes,
        "precision": precision,
        "sensitivity": sensitivity,
        "obstacles": obstacles,
        "poison": poison,
        "free": free,
    }
)


def battery(subject: Subject, size: Size, groups: Mapping[str, Group] = GROUPS) -> Iterator[Line]:
    """Run the tests of an emulator.

    Args:
        subject: The emulator, and its simulator where there is one.
        size: Amount of work.
        groups: The tests to run, by name.

    Yields:
        Each line as soon as it is known.
    """
    with torch.no_grad():
        for group in groups.values():
            yield from group(subject, size)
