"""The cores that a process may use, and work on ranges of items by threads that leave the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def usable_cores(root: Path = Path("/sys/fs/cgroup"), groups: Path = Path("/proc/self/cgroup")) -> int:
    """Processor cores that this process may use: by its affinity and its container's quota, at least 1.

    Args:
        root: Where the system's control groups are mounted.
        groups: The file that names those of this process.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, round(_quota(root, groups) or cores)))


def split(count: int, size: int) -> list[tuple[int, int]]:
    """The ranges of at most `size` that cover `count` items; they do not depend on the number of threads."""
    return [(low, min(low + size, count)) for low in range(0, count, size)]


def for_each(work: Callable[[int], object], count: int, threads: int) -> None:
    """Call `work` with 0 … count - 1, each the work of one thread; see `map_ranges`."""
    map_ranges(lambda low, _: work(low), split(count, 1), threads)


def map_ranges(function: Callable[[int, int], T], ranges: list[tuple[int, int]], threads: int) -> list[T]:
    """The function's results for each range (low, high), in order.

    Threads live for one call: none is left behind for a process that forks, and none is needed for a single range.

    Args:
        function: Is called from several threads; it should release the interpreter's lock.
        ranges: From `split`.
        threads: How many work at most.
    """
    if threads == 1 or len(ranges) < 2:
        return [function(low, high) for low, high in ranges]
    with ThreadPoolExecutor(min(threads, len(ranges))) as pool:
        return list(pool.map(lambda both: function(*both), ranges))


def _quota(root: Path, groups: Path) -> float | None:
    """Cores that the control groups of this process allow it, the least of them; None where there is no limit."""
    try:
        lines = [line.split(":", 2) for line in groups.read_text().splitlines()]
    except OSError:
        return None
    limits = [_limit(folder / "cpu.max") for _, kinds, path in lines if not kinds for folder in _upwards(root, path)]
    first = [path for _, kinds, path in lines if "cpu" in kinds.split(",")]  # of the first version of control groups
    folders = [folder for path in first for folder in _upwards(root / "cpu", path)]
    limits += [_limit(folder / "cpu.cfs_quota_us", folder / "cpu.cfs_period_us") for folder in folders]
    return min((limit for limit in limits if limit is not None), default=None)


def _upwards(root: Path, path: str) -> list[Path]:
    """The folders from the root of a hierarchy down to a group; in a container the group's own may be the root."""
    parts = [part for part in path.split("/") if part not in ("", "..")]
    return [root.joinpath(*parts[:depth]) for depth in range(len(parts) + 1)]


def _limit(*files: Path) -> float | None:
    """Quota over period, from a file that holds both or from two; None where there is none."""
    try:
        quota, period = " ".join(file.read_text() for file in files).split()
        return float(quota) / float(period) if float(quota) > 0 else None
    except (OSError, ValueError):  # no such file, or "max"
        return None
