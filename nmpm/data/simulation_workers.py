"""Who simulates the trajectories of a dataset: threads of this process, or processes.

Threads share the interpreter's lock, which a simulator's kernels release for a tenth of a millisecond at a time: of
many threads most wait for it. Where there is much to simulate, each worker is therefore a process, started anew by the
Python that runs this one. `multiprocessing` would import the caller's script in each of them, which a script without
`if __name__ == "__main__"` does not survive.

A process reads a trajectory, split and index, per line of its standard input, and answers each with a line that begins
with `_ANSWER` and goes on in JSON. It ends with its input, and when the process that started it does.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any, Protocol, TextIO, cast

from nmpm import errors
from nmpm.data.parts import part_path, remove_unfinished_parts, request_path, write_part
from nmpm.data.seeds import simulate_first_stable
from nmpm.data.simulation_request import SimulationRequest
from nmpm.errors import DataError, NmpmError
from nmpm.sim.loading import preset_from_dict

FRAMES_PER_PROCESS = 1500
"""Frames of a worker from which on it is a process: these take seconds at least, the start of a process one or two."""
_LAST_SECONDS = 5
"""In which a process that has closed its output ends by itself."""
_ANSWER = "nmpm-answer "
_START = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); "  # Ctrl-C reaches all: who started it ends it
    "from nmpm.data.simulation_workers import serve; serve()"
)
_log = logging.getLogger(__name__)


class Worker(Protocol):
    """Simulates one trajectory after the other."""

    def simulate(self, split: str, index: int) -> None:
        """Write the part of a trajectory."""

    def stop(self) -> None:
        """End it soon, also while another thread calls `simulate`."""

    def close(self) -> None:
        """Stop it and release what it holds, when no thread calls `simulate` any more."""


@contextlib.contextmanager
def started_workers(
    request: SimulationRequest, folder: Path, count: int, trajectories: int
) -> Iterator[tuple[Worker, ...]]:
    """Workers for a number of trajectories, which are closed at the end; the folder has the request beside its parts.

    Args:
        request: What is simulated.
        folder: The dataset's.
        count: Workers at most.
        trajectories: That are to be simulated.

    Raises:
        DataError: if a process cannot be started.
    """
    count = min(count, trajectories)
    much = trajectories * request.preset.frames >= FRAMES_PER_PROCESS * count
    in_processes = count > 1 and much and _runs_scripts() and _can_be_sent(request)
    with contextlib.ExitStack() as stack:
        workers: list[Worker] = []
        for _ in range(count):
            workers.append(ProcessWorker(folder) if in_processes else ThreadWorker(request, folder))
            stack.callback(workers[-1].close)
        yield tuple(workers)


def _runs_scripts() -> bool:
    """Whether the executable of this process is a Python, and not a program that Python is a part of."""
    return bool(sys.executable) and not getattr(sys, "frozen", False)


def _can_be_sent(request: SimulationRequest) -> bool:
    """Whether another process would read the same request from its file: not with a preset of a class of the user's."""
    try:
        return _request_from(json.loads(json.dumps(request.to_dict()))).preset == request.preset
    except (NmpmError, TypeError):
        return False


def _request_from(plain: dict[str, Any]) -> SimulationRequest:
    return SimulationRequest(preset_from_dict(plain["preset"]), plain["counts"], plain["seed"])


class ThreadWorker:
    """Simulates in the thread that calls it.

    Args:
        request: What is simulated.
        folder: The dataset's.
    """

    def __init__(self, request: SimulationRequest, folder: Path) -> None:
        self._request, self._folder, self._stopped = request, folder, threading.Event()

    def simulate(self, split: str, index: int) -> None:
        """Write the part of a trajectory.

        Raises:
            CancelledError: after `stop`.
        """
        self._go_on()
        run = simulate_first_stable(self._request.preset, self._request.entropy(split, index), self._go_on)
        self._go_on()
        write_part(part_path(self._folder, split, index), run)

    def _go_on(self, _: int = 0) -> None:
        if self._stopped.is_set():
            raise CancelledError

    def stop(self) -> None:
        """Let it end after the frame that it simulates."""
        self._stopped.set()

    def close(self) -> None:
        """Let it end; it holds nothing."""
        self.stop()


class _OwnedWorker(ThreadWorker):
    """Ends this process, within a frame, when the one that started it has ended, even by kill -9.

    The folder's lock has ended with it: nothing may be written any more.
    """

    def __init__(self, request: SimulationRequest, folder: Path, owner: int) -> None:
        super().__init__(request, folder)
        self._owner = owner

    def _go_on(self, _: int = 0) -> None:
        if os.getppid() != self._owner:
            raise SystemExit


class ProcessWorker:
    """Simulates in a process of its own.

    Args:
        folder: The dataset's.

    Raises:
        DataError: if the process cannot be started.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        paths = {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path), "OMP_NUM_THREADS": "1"}
        try:
            self._process = subprocess.Popen(  # noqa: S603
                [sys.executable, "-P", "-c", _START, str(folder.resolve()), str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                encoding="utf-8",
                errors="replace",
                env=os.environ | paths,
            )
        except OSError as error:
            raise DataError(f"A process that simulates cannot be started ({error}): ask for fewer workers.") from error
        self._questions, self._answers = cast(TextIO, self._process.stdin), cast(TextIO, self._process.stdout)

    def simulate(self, split: str, index: int) -> None:
        """Write the part of a trajectory.

        Raises:
            NmpmError: what the simulation raises there.
            OSError: if the part cannot be written.
            DataError: if the process ends before it answers.
            RuntimeError: if the simulation fails in another way, with the traceback.
        """
        answer = self._ask(f"{split} {index}")
        for text in answer["warnings"]:
            _log.warning("%s", text)
        if (name := answer["error"]) is not None:
            kinds: dict[str, type[Exception]] = {"OSError": OSError} | vars(errors)
            raise kinds.get(name, RuntimeError)(answer["text"])

    def _ask(self, trajectory: str) -> dict[str, Any]:
        try:
            self._questions.write(trajectory + "\n")
            self._questions.flush()
            line = next((line for line in self._answers if line.startswith(_ANSWER)), "")
            answer: dict[str, Any] = json.loads(line.removeprefix(_ANSWER))
        except (OSError, ValueError) as error:  # a broken or closed pipe; half a line, or none
            status = self._end()
            why = "was it killed, or is memory short?" if status < 0 else "see its traceback above."
            raise DataError(
                f"A process that simulated {trajectory} ended with status {status}: {why} Repeat the call to continue;"
                " fewer workers take less memory."
            ) from error
        return answer

    def _end(self) -> int:
        """The status with which it ends by itself, or else is killed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self._process.wait(_LAST_SECONDS)
        self._process.kill()
        return self._process.wait()

    def stop(self) -> None:
        """End it at once, and delete the part that it was writing."""
        self._process.kill()
        self._process.wait()
        remove_unfinished_parts(self._folder, self._process.pid)

    def close(self) -> None:
        """End it and close the pipes."""
        self.stop()
        with contextlib.suppress(OSError):  # what is left to be sent to it
            self._questions.close()
        self._answers.close()


class _Texts(logging.Handler):
    """Keeps the texts of warnings, to be logged where the user sees them."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())


def serve() -> None:
    """Simulate what the standard input asks for until it ends; the command line has the folder and who started this."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # nothing that prints may mix with the answers
    warnings = _Texts()
    logging.getLogger("nmpm").addHandler(warnings)
    folder, owner = Path(sys.argv[1]), int(sys.argv[2])
    request = _request_from(json.loads(request_path(folder).read_text(encoding="utf-8")))
    worker = _OwnedWorker(request, folder, owner)
    for line in sys.stdin:
        split, index = line.split()
        error, text = _outcome(worker, split, int(index))
        answers.write(f"{_ANSWER}{json.dumps({'error': error, 'text': text, 'warnings': warnings.texts})}\n")
        answers.flush()
        warnings.texts.clear()


def _outcome(worker: Worker, split: str, index: int) -> tuple[str | None, str]:
    """What went wrong: the name of an error of `nmpm` or of `OSError` and its text, or the traceback of another."""
    try:
        worker.simulate(split, index)
    except NmpmError as error:
        return type(error).__name__, str(error)
    except OSError as error:
        return "OSError", str(error)
    except Exception:
        return "RuntimeError", f"The simulation of {split} {index} failed:\n{traceback.format_exc()}"
    return None, ""
