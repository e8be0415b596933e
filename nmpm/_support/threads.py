"""Threads: how many a process may use and uses, work on ranges of items by several, and tasks that stop soon.

Threads that wait for one another inside of small operations gain little on a quiet machine, and on a busy one each
waits for a core that does other work. So `ThreadChoice` measures, and measures again, as load changes.

A thread that is killed while it reads a file leaves HDF5's lock locked, and a thread that outlives its owner competes
with whatever comes next. So a `Task` is waited for, and long work calls `raise_if_abandoned` between its steps.
"""

from __future__ import annotations

import os
import statistics
import threading
import time
from collections.abc import Callable, Mapping, MutableMapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar, copy_context
from typing import Generic, TypeVar

from nmpm._support.messages import counted

T = TypeVar("T")

WAITING_POLICIES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
"""Environment variables by which a user says how OpenMP's threads wait."""
SPIN_COUNT = 1000
"""Turns of the loop in which a waiting thread of libgomp spins before it sleeps; its default is 300,000 or more."""

SKIPPED = 2
"""First calls, in which kernels are compiled, that are not measured."""
TRIALS = 3
"""Calls by which a number of threads is judged, fewer if the first takes `HOPELESS` times as long as the others'."""
HOPELESS = 3.0
LOOK_AGAIN = 30.0
"""Seconds from one measurement to the next, or `LOOK_AGAIN_SHARE` times what it took."""
LOOK_AGAIN_SHARE = 50


def usable_cores() -> int:
    """Processor cores that this process may use: by its affinity and its container's quota, at least 1."""
    from joblib import cpu_count  # here, as it imports NumPy

    return int(cpu_count())


def split(count: int, size: int) -> list[tuple[int, int]]:
    """The ranges of at most `size` that cover `count` items; they do not depend on the number of threads."""
    return [(low, min(low + size, count)) for low in range(0, count, size)]


def for_each(work: Callable[[int], object], count: int, threads: int) -> None:
    """Call `work` with 0 … count - 1, each the work of one thread; see `map_ranges`."""
    map_ranges(lambda low, _: work(low), split(count, 1), threads)


def map_ranges(function: Callable[[int, int], T], ranges: list[tuple[int, int]], threads: int) -> list[T]:
    """The function's results for each range (low, high), in order.

    The function is called from up to `threads` threads, and should release the interpreter's lock. Threads live for
    one call: none is left behind for a process that forks, and none is needed for a single range.
    """
    if threads == 1 or len(ranges) < 2:
        return [function(low, high) for low, high in ranges]
    with ThreadPoolExecutor(min(threads, len(ranges))) as pool:
        return list(pool.map(lambda both: function(*both), ranges))


def limit_spinning(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let OpenMP's threads sleep soon instead of spinning, unless the user has chosen; before torch is imported."""
    if not any(name in environment for name in WAITING_POLICIES):
        environment["GOMP_SPINCOUNT"] = str(SPIN_COUNT)


def stated_threads(option: int | None, environment: Mapping[str, str] = os.environ) -> int | None:
    """The number of threads that the user asks for, by an option or by OMP_NUM_THREADS; None without either."""
    stated = environment.get("OMP_NUM_THREADS", "").split(",")[0]
    if option:
        return int(option)  # (jsonargparse's is of a type of its own, which checkpoints must not hold)
    return int(stated) if stated.isdigit() and int(stated) > 0 else None


class ThreadChoice:
    """Runs calls of the same work by the faster of one thread and of all.

    Args:
        stated: The number of threads that the user asks for; None to measure one against all usable cores.
        apply: Is told the number before each call.
        clock: Gives seconds.

    Attributes:
        most: All threads.
        threads: How many the next call gets.
        medians: Seconds of a call by number of threads, as last measured; empty before.
    """

    def __init__(
        self, stated: int | None, apply: Callable[[int], object], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self.most = self.threads = stated or usable_cores()
        self._candidates = [self.most] if stated or self.most == 1 else [self.most, 1]
        self._apply, self._clock = apply, clock
        self._calls, self._times = 0, dict[int, list[float]]()
        self._since, self._next_look = 0.0, -1.0
        self.medians: dict[int, float] = {}

    def __str__(self) -> str:
        if len(self._candidates) == 1:
            return counted(self.most, "thread")
        return f"{counted(self.most, 'thread')}, or one where that is faster"

    def start(self) -> None:
        """Start a call, and its clock."""
        self._apply(self.threads)
        self._since = self._clock()

    def stop(self) -> None:
        """End a call, and choose the number of threads of the next."""
        now = self._clock()
        self._calls += 1
        if len(self._candidates) == 1 or self._calls <= SKIPPED or now < self._next_look:
            return
        self._times.setdefault(self.threads, []).append(now - self._since)
        untried = [threads for threads in self._candidates if not self._judged(threads)]
        if untried:
            self.threads = untried[0]
            return
        self.medians = {threads: statistics.median(times) for threads, times in self._times.items()}
        self.threads = min(self.medians, key=self.medians.__getitem__)
        self._next_look = now + max(LOOK_AGAIN, LOOK_AGAIN_SHARE * sum(map(sum, self._times.values())))
        self._times = {}

    def _judged(self, threads: int) -> bool:
        """Whether a number of threads was measured often enough."""
        mine = self._times.get(threads, [])
        others = [seconds for other, times in self._times.items() if other != threads for seconds in times]
        return len(mine) >= TRIALS or bool(mine and others and min(mine) > HOPELESS * max(others))


_POLL_SECONDS = 0.05

_cancelled: ContextVar[threading.Event | None] = ContextVar("cancelled", default=None)
"""Set when the task that the current thread works for is cancelled."""


class AbandonedError(Exception):
    """The work was given up: its task was cancelled, or the program exits."""


def raise_if_abandoned() -> None:
    """Raise AbandonedError if the current task was cancelled or the program is about to exit."""
    cancelled = _cancelled.get()
    if not threading.main_thread().is_alive() or (cancelled is not None and cancelled.is_set()):
        raise AbandonedError


class Task(Generic[T]):
    """Calls a function in a thread of its own, from now on."""

    def __init__(self, function: Callable[[], T]) -> None:
        self._future: Future[T] = Future()
        self._cancelled = threading.Event()
        context = copy_context()
        context.run(_cancelled.set, self._cancelled)
        self._thread = threading.Thread(target=context.run, args=(self._work, function))
        self._thread.start()

    def _work(self, function: Callable[[], T]) -> None:
        try:
            self._future.set_result(function())
        except BaseException as error:
            self._future.set_exception(error)

    def result(self) -> T:
        """Wait for the function and return its value, or raise its exception.

        Raises AbandonedError if this task, or the one that waits for it, is cancelled.
        """
        while not self._future.done():
            raise_if_abandoned()
            self._thread.join(_POLL_SECONDS)
        return self._future.result()

    @property
    def failed(self) -> bool:
        """Whether the function has raised."""
        return self._future.done() and self._future.exception() is not None

    def cancel(self) -> None:
        """Makes the function stop at its next `raise_if_abandoned`, and waits until its thread has ended."""
        self._cancelled.set()
        self._thread.join()
