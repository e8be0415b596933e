"""Tasks in threads that stop soon when they are cancelled or the program exits.

A thread that is killed while it reads a file leaves HDF5's lock locked, and a thread that outlives its owner competes
with whatever comes next. So threads are waited for, and long work calls `raise_if_abandoned` between its steps.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextvars import ContextVar, copy_context
from queue import Empty, SimpleQueue
from typing import Generic, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
S = TypeVar("S")

_POLL_SECONDS = 0.05

_cancelled: ContextVar[threading.Event | None] = ContextVar("cancelled", default=None)
"""Set when the task that the current thread works for is cancelled; a task's own threads inherit it."""


class AbandonedError(Exception):
    """The work was given up: its task was cancelled, or the program exits."""


def raise_if_abandoned() -> None:
    """Stops work whose result is no longer needed.

    Raises:
        AbandonedError: if the current task was cancelled or the program is about to exit.
    """
    cancelled = _cancelled.get()
    if not threading.main_thread().is_alive() or (cancelled is not None and cancelled.is_set()):
        raise AbandonedError


class Task(Generic[T]):
    """A function that runs in a thread of its own; `run_in_thread` starts one."""

    def __init__(self, function: Callable[[], T], cancelled: threading.Event) -> None:
        self._future: Future[T] = Future()
        self._cancelled = cancelled
        context = copy_context()
        context.run(_cancelled.set, cancelled)
        self._thread = threading.Thread(target=context.run, args=(self._work, function))
        self._thread.start()

    def _work(self, function: Callable[[], T]) -> None:
        try:
            self._future.set_result(function())
        except BaseException as error:
            self._future.set_exception(error)

    def result(self) -> T:
        """Waits for the function and returns its value.

        Raises:
            AbandonedError: if this task, or the one that waits for it, is cancelled.
            Exception: what the function raised.
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
        self.join()

    def join(self) -> None:
        """Waits until the thread has ended, whatever the outcome."""
        self._thread.join()


def run_in_thread(function: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> Task[T]:
    """Calls a function in a thread of its own."""
    return Task(lambda: function(*arguments, **options), threading.Event())


def map_in_threads(function: Callable[[S], T], items: Sequence[S], workers: int) -> list[T]:
    """Computes the function's values for all items, in their order, in several threads.

    The threads belong to the current task: cancelling it cancels them.

    Raises:
        Exception: the first that the function raised, once the items that were begun by then are done; others are
            skipped.
    """
    waiting: SimpleQueue[tuple[int, S]] = SimpleQueue()
    for numbered in enumerate(items):
        waiting.put(numbered)
    values: dict[int, T] = {}

    def work() -> None:
        try:
            while True:
                index, item = waiting.get_nowait()
                raise_if_abandoned()
                values[index] = function(item)
        except Empty:
            return
        except BaseException:
            _drain(waiting)
            raise

    cancelled = _cancelled.get() or threading.Event()
    tasks = [Task(work, cancelled) for _ in range(min(workers, len(items)))]
    try:
        for task in tasks:
            task.result()
    finally:
        for task in tasks:
            task.join()
    return [values[index] for index in range(len(items))]


def _drain(waiting: SimpleQueue[tuple[int, S]]) -> None:
    try:
        while True:
            waiting.get_nowait()
    except Empty:
        return
