"""Work beside the main thread that soon ends when the program does.

The threads are waited for at the program's end, as one that dies while it reads a file would leave the file's lock held
for ever. So whatever takes long asks `raise_if_abandoned` from time to time.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from queue import Empty, SimpleQueue
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
S = TypeVar("S")


class AbandonedError(Exception):
    """The program ends, and nobody will ask for the result."""


def raise_if_abandoned() -> None:
    """Lets work in the background go on.

    Raises:
        AbandonedError: if the program is about to end.
    """
    if not threading.main_thread().is_alive():
        raise AbandonedError


def run_in_thread(function: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> Future[T]:
    """Calls a function in a thread of its own."""
    future: Future[T] = Future()

    def work() -> None:
        try:
            future.set_result(function(*arguments, **options))
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=work).start()
    return future


def map_in_threads(function: Callable[[S], T], items: Sequence[S], workers: int) -> list[T]:
    """The function's values for all items, in their order, by several threads.

    Raises:
        Exception: the first that the function raised; what is not begun by then is left.
    """
    waiting: SimpleQueue[tuple[int, S]] = SimpleQueue()
    for numbered in enumerate(items):
        waiting.put(numbered)
    done: dict[int, T] = {}

    def work() -> None:
        try:
            while True:
                index, item = waiting.get_nowait()
                raise_if_abandoned()
                done[index] = function(item)
        except Empty:
            return
        except BaseException:
            _drain(waiting)
            raise

    for future in [run_in_thread(work) for _ in range(min(workers, len(items)))]:
        future.result()
    return [done[index] for index in range(len(items))]


def _drain(waiting: SimpleQueue[tuple[int, S]]) -> None:
    try:
        while True:
            waiting.get_nowait()
    except Empty:
        return
