"""Memory that a process may still take."""

from __future__ import annotations

import math
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")


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
