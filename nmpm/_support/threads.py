"""Threads: how many a process may use and uses, work on ranges of items by several, and tasks that stop soon.

Threads that wait for one another inside of small operations gain little on a quiet machine, and on a busy one each
waits for a core that does other work. So `ThreadChoice` measures, and measures again, as load changes.

A thread that is killed while it reads a file leaves HDF5's lock locked, and a thread that outlives its owner competes
with whatever comes next. So a `Task` is waited for, and long work calls `raise_if_abandoned` between its steps.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, MutableMapping, Sequence
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
PAIRS = 5
"""Calls by which each number of threads is judged, in turn; `HOPELESS_PAIRS` if one takes `HOPELESS` times as long."""
HOPELESS, HOPELESS_PAIRS = 3.0, 3
QUANTILE = 0.25
"""Of these calls' times, by which numbers of threads are compared: what other programs disturb is slower."""
MARGIN = 0.95
"""The number in use stays unless the other takes less than this share of its time."""
LOOK_AGAIN = 30.0
"""Seconds from one measurement to the next, or `LOOK_AGAIN_SHARE` times those that the slower number has cost."""
LOOK_AGAIN_SHARE = 25
CHANGED, CHANGED_CALLS, SOON_SHARE = 1.25, 5, 10
"""So many calls in a row this much slower or faster than measured mean another load: measure again, if the last
measurement is `SOON_SHARE` times as long ago as it has cost."""


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
        seconds: Of an undisturbed call by number of threads, as last measured; empty before.
    """

    def __init__(
        self, stated: int | None, apply: Callable[[int], object], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self.most = self.threads = self._chosen = stated or usable_cores()
        self._candidates = [self.most] if stated or self.most == 1 else [self.most, 1]
        self._apply, self._clock = apply, clock
        self._calls, self._times = 0, dict[int, list[float]]()
        self._recent: deque[float] = deque(maxlen=CHANGED_CALLS)
        self._since, self._next_look, self._soonest = 0.0, -math.inf, -math.inf
        self.seconds: dict[int, float] = {}

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
        if len(self._candidates) == 1 or self._calls <= SKIPPED:
            return
        if now < self._next_look:
            self._recent.append(now - self._since)
            if self._has_changed() and now >= self._soonest:
                self._next_look = now
            return
        self._times.setdefault(self.threads, []).append(now - self._since)
        if self._is_judged():
            self._choose(now)
        else:
            self.threads = min(self._candidates, key=lambda threads: len(self._times.get(threads, [])))

    def _has_changed(self) -> bool:
        """Whether recent calls all were slower, or all faster, than measured."""
        if len(self._recent) < CHANGED_CALLS:
            return False
        expected = self.seconds[self.threads]
        return min(self._recent) > CHANGED * expected or CHANGED * max(self._recent) < expected

    def _is_judged(self) -> bool:
        """Whether all numbers of threads were measured often enough."""
        times = [self._times.get(threads, []) for threads in self._candidates]
        least = min(map(len, times))
        hopeless = least >= HOPELESS_PAIRS and max(map(min, times)) > HOPELESS * min(map(max, times))
        return least >= PAIRS or hopeless

    def _choose(self, now: float) -> None:
        self.seconds = {threads: _lower_quantile(times) for threads, times in self._times.items()}
        fastest = min(self.seconds, key=self.seconds.__getitem__)
        if self.seconds[fastest] < MARGIN * self.seconds[self._chosen]:
            self._chosen = fastest
        self.threads, best = self._chosen, self.seconds[self._chosen]
        cost = sum(
            max(0.0, seconds - best) for n, times in self._times.items() if n != self.threads for seconds in times
        )
        self._next_look = now + max(LOOK_AGAIN, LOOK_AGAIN_SHARE * cost)
        self._soonest = now + SOON_SHARE * cost
        self._times = {}
        self._recent.clear()


def _lower_quantile(values: Sequence[float]) -> float:
    return sorted(values)[int(QUANTILE * len(values))]


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
