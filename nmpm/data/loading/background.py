"""Tasks in threads that stop soon when they are cancelled or the program exits.

A thread that is killed while it reads a file leaves HDF5's lock locked, and a thread that outlives its owner competes
with whatever comes next. So threads are waited for, and long work calls `raise_if_abandoned` between its steps.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextvars import ContextVar, copy_context
from typing import Generic, TypeVar

T = TypeVar("T")

_POLL_SECONDS = 0.05

_cancelled: ContextVar[threading.Event | None] = ContextVar("cancelled", default=None)
"""Set when the task that the current thread works for is cancelled."""


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
    """Calls a function in a thread of its own, from now on.

    Args:
        function: What to call.
    """

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
        self._thread.join()
