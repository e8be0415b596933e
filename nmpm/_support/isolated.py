"""Runs native parsers in child processes with a memory limit: their crash is one error, and this process goes on.

A child serves one call after the other, so that starting it and importing the parser cost once. It ends when it has had
no call for some seconds, or with its parent. It executes functions of this package only, and returns plain data and
arrays of numbers and texts, nothing pickled.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from nmpm import errors
from nmpm._support.bounded_files import expansion_limit
from nmpm._support.machine import free_memory
from nmpm._support.messages import one_line
from nmpm.errors import DataError, NmpmError

_COPIES = 3
"""Of a file's unpacked content, in the parser, in arrays, and on their way."""
_OWN_BYTES = 2**28
"""For the parser's libraries."""
_IDLE_SECONDS = 10.0
_PIPE_BYTES = 2**20
_START = "from nmpm._support.isolated import serve; serve()"
_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}
"""Threads, which a parser does not need, would count as memory."""


def call_isolated(function: Callable[..., Any], path: Path, *arguments: Any) -> Any:
    """What `function(path, *arguments)` returns, computed in a child process.

    Args:
        function: Of a module that is cheap to import; returns numbers, texts, None, arrays, and lists and mappings of
            these.
        path: The file that it reads.
        arguments: Numbers, texts, and lists of them.

    Raises:
        DataError: if the file needs more memory than its size allows, or the child ends.
        NmpmError: as the function does.
    """
    (value,) = iterate_isolated(function, path, *arguments)
    return value


def iterate_isolated(function: Callable[..., Any], path: Path, *arguments: Any) -> Iterator[Any]:
    """Yields what `function(path, *arguments)` yields, as far as it is asked for; else as `call_isolated`."""
    limit = int(min(_OWN_BYTES + _COPIES * expansion_limit(path.stat().st_size), free_memory()))
    request = [f"{function.__module__}:{function.__name__}", str(path), list(arguments), limit]
    idle = _idle_children(os.getpid())
    child = idle.pop() if idle else _Child()
    if child.may_end():
        child.end()
        child = _Child()
    try:
        kind, content = child.ask(request, path)
        while kind == "item":
            yield content
            kind, content = child.ask([], path)
    finally:
        if child.is_busy:
            child.end()
        else:
            idle.append(child)


@cache
def _idle_children(process: int) -> list[_Child]:  # noqa: ARG001 (a forked process does not share its parent's)
    return []


class _Child:
    """A child process, started."""

    def __init__(self) -> None:
        folders = os.pathsep.join(path for path in sys.path if path)
        self._process = subprocess.Popen(  # noqa: S603 (this interpreter)
            [sys.executable, "-P", "-c", _START],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | _ENVIRONMENT | {"PYTHONPATH": folders},
            pipesize=_PIPE_BYTES,
            start_new_session=True,  # Ctrl-C is its parent's
        )
        self.is_busy, self._last_used = False, time.monotonic()

    def may_end(self) -> bool:
        """Whether it has ended, or may before it reads the next request, as it has been idle."""
        return self._process.poll() is not None or time.monotonic() - self._last_used > _IDLE_SECONDS / 2

    def ask(self, request: list[Any], path: Path) -> tuple[str, Any]:
        """The answer to a call, or to an empty request for its next item: an "item", or the "end".

        Raises:
            NmpmError: that the function raised.
            DataError: if the process ended.
        """
        self.is_busy = True
        requests, answers = cast(BinaryIO, self._process.stdin), cast(BinaryIO, self._process.stdout)
        try:
            requests.write(json.dumps(request).encode() + b"\n")
            requests.flush()
            kind, content = _read_message(answers)
        except (OSError, EOFError, ValueError) as error:
            status = self.end()
            name = signal.Signals(-status).name if status < 0 else f"status {status}"
            raise DataError(
                f"{path}: cannot be read: its parser ended ({name}): it is damaged, or asks for more memory than its"
                " size allows. Is it complete? Copy it again."
            ) from error
        self.is_busy, self._last_used = False, time.monotonic()
        if kind in ("item", "end"):
            return kind, content
        raise getattr(errors, kind)(content)

    def end(self) -> int:
        """End the process; its status, its own if it ends by itself where nobody asks or listens any more."""
        for stream in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                cast(BinaryIO, stream).close()
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(1.0)
        self._process.kill()
        return self._process.wait()


def serve() -> None:
    """Answer the requests that come by standard input; by standard output, which parsers cannot write to."""
    requests = os.fdopen(os.dup(0), "rb", buffering=0)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    path, items = "", iter(())
    with suppress(BrokenPipeError):
        while line := _next_request(requests):
            if request := json.loads(line):
                path, items = request[1], _call(*request)
            _write_message(answers, *_answer(path, items))


def _next_request(requests: BinaryIO) -> bytes:
    """A line; empty at the end, or after some seconds without one."""
    if os.name == "posix":
        import select

        if not select.select([requests], [], [], _IDLE_SECONDS)[0]:
            return b""
    return requests.readline()


def _call(name: str, path: str, arguments: list[Any], limit: int) -> Iterator[Any]:
    """What a function of this package yields, or the one value that it returns."""
    _limit_memory(limit)
    module, _, function = name.partition(":")
    result = getattr(import_module(module), function)(Path(path), *arguments)
    yield from result if isinstance(result, Iterator) else [result]


def _answer(path: str, items: Iterator[Any]) -> tuple[str, Any]:
    try:
        for item in items:
            return "item", item
    except NmpmError as error:
        return type(error).__name__, str(error)
    except Exception as error:  # damaged files may make a parser raise anything
        reason = one_line(error, 300) or type(error).__name__
        return "DataError", f"{path}: cannot be read ({reason}). Is it complete? Copy it again."
    return "end", None


def _limit_memory(extra: int) -> None:
    """Limit this process to so many bytes more than it has, where the system can."""
    try:
        import resource

        used = re.search(r"VmData:\s+(\d+)", Path("/proc/self/status").read_text())
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if used is not None:
            limit = 1024 * int(used[1]) + extra
            resource.setrlimit(resource.RLIMIT_DATA, (limit if hard < 0 else min(limit, hard), hard))
    except (ImportError, OSError, ValueError):
        return


def _write_message(stream: BinaryIO, kind: str, content: Any) -> None:
    """A line of JSON that has kind and shape in place of arrays, and then their numbers."""
    arrays: list[np.ndarray] = []

    def describe(array: np.ndarray) -> dict[str, Any]:
        arrays.append(np.ascontiguousarray(array))
        return {"dtype": arrays[-1].dtype.str, "shape": array.shape}

    stream.write(json.dumps([kind, content], default=describe).encode() + b"\n")
    for array in arrays:
        stream.write(array.reshape(-1).view(np.uint8).data if array.size else b"")
    stream.flush()


def _read_message(stream: Any) -> tuple[str, Any]:
    def read(item: dict[str, Any]) -> Any:
        if set(item) != {"dtype", "shape"}:
            return item
        dtype = np.dtype(item["dtype"])
        if dtype.kind not in "biufmMSU":
            raise ValueError("neither numbers nor texts")
        array = np.empty(item["shape"], dtype)
        octets = array.reshape(-1).view(np.uint8).data if array.size else memoryview(b"")
        if array.size and stream.readinto(octets) != len(octets):
            raise EOFError
        return array

    line = stream.readline()
    if not line.endswith(b"\n"):
        raise EOFError
    kind, content = json.loads(line, object_hook=read)
    return kind, content
