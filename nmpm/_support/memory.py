"""Memory that a process may still take."""

from __future__ import annotations

import math
from pathlib import Path

from nmpm.errors import DataError

_CGROUP = Path("/sys/fs/cgroup")
_ALWAYS = 2**28
"""Bytes for which nobody is asked."""


def check_fits(frames: int, particles: int, values: int, where: str) -> None:
    """Refuses, with a DataError, an array of so many values per particle and frame for which memory does not suffice.

    Files of few bytes can ask for it, by frames that are far apart, or particles that are in few frames.
    """
    size = 4 * frames * particles * max(values, 1)
    if size > _ALWAYS and size > free_memory():
        raise DataError(
            f"{where}: {frames:,} frames of {particles:,} particles need {size / 2**30:,.1f} GiB of memory,"
            f" {free_memory() / 2**30:.1f} are free. Cut the run along time, or leave particles out."
        )


def free_memory() -> float:
    """Bytes of main memory that are free, within the container's limit; infinite where the system does not say."""
    return min(_available(), _left_in_container())


def _available() -> float:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return math.inf
    sizes = {name: value for name, _, value in (line.partition(":") for line in lines)}
    return 1024.0 * float(sizes["MemAvailable"].split()[0]) if "MemAvailable" in sizes else math.inf


def _left_in_container() -> float:
    try:
        limit, used = ((_CGROUP / f"memory.{name}").read_text().strip() for name in ("max", "current"))
        cached = dict(line.split() for line in (_CGROUP / "memory.stat").read_text().splitlines())
    except OSError:
        return math.inf
    return math.inf if limit == "max" else float(limit) - float(used) + float(cached.get("inactive_file", 0))
