"""Work on ranges of items, by threads that leave the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def processor_count() -> int:
    """Processor cores that this process may use, as far as the system tells."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
