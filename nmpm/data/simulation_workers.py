"""Who simulates the trajectories of a dataset: threads of this process, or processes.

Threads share the interpreter's lock, which a simulator's kernels release for a tenth of a millisecond at a time: of
many threads most wait for it. Where there is much to simulate, each worker is therefore a process, started anew by the
Python that runs this one. `multiprocessing` would import the caller's script in each of them, which a script without
`if __name__ == "__main__"` does not survive.

A process reads a trajectory, split and index, per line of its standard input, and answers each with a line of JSON. It
ends with its input, and when the process that started it does.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any, Protocol, TextIO, cast

from nmpm import errors
from nmpm.data.parts import part_path, request_path, write_part
from nmpm.data.seeds import simulate_first_stable
from nmpm.data.simulation_request import SimulationRequest
from nmpm.errors import DataError, NmpmError
from nmpm.sim.loading import preset_from_dict

PER_PROCESS = 8
"""Trajectories of a worker from which on it is a process, which takes a second or two to start."""
_START = "from nmpm.data.simulation_workers import serve; serve()"
_log = logging.getLogger(__name__)


class Worker(Protocol):
    """Simulates one trajectory after the other."""

    def simulate(self, split: str, index: int) -> None:
        """Write the part of a trajectory."""

    def stop(self) -> None:
        """End it soon, also while it simulates; may be called by another thread."""


def start_workers(request: SimulationRequest, folder: Path, count: int, trajectories: int) -> Sequence[Worker]:
    """Workers for a number of trajectories; the folder has the request beside its parts.

    Args:
        request: What is simulated.
        folder: The dataset's.
        count: Workers at most.
        trajectories: That are to be simulated.
    """
    count = min(count, trajectories)
    if count > 1 and trajectories >= PER_PROCESS * count and _can_be_sent(request):
        return [ProcessWorker(folder) for _ in range(count)]
    return [ThreadWorker(request, folder) for _ in range(count)]


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
        run = simulate_first_stable(self._request.preset, self._request.entropy(split, index), self._stop_early)
        write_part(part_path(self._folder, split, index), run)

    def _stop_early(self, _: int) -> None:
        if self._stopped.is_set():
            raise CancelledError

    def stop(self) -> None:
        """Let it end after the frame that it simulates."""
        self._stopped.set()


class _OwnedWorker(ThreadWorker):
    """Ends this process, within a frame, when the one that started it has ended, even by kill -9."""

    def __init__(self, request: SimulationRequest, folder: Path) -> None:
        super().__init__(request, folder)
        self._owner = os.getppid()

    def _stop_early(self, _: int) -> None:
        if os.getppid() != self._owner:
            raise SystemExit


class ProcessWorker:
    """Simulates in a process of its own.

    Args:
        folder: The dataset's.
    """

    def __init__(self, folder: Path) -> None:
        paths = {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path), "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(  # noqa: S603
            [sys.executable, "-c", _START, str(folder.resolve())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            env=os.environ | paths,
        )

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
        questions, answers = cast(TextIO, self._process.stdin), cast(TextIO, self._process.stdout)
        try:
            questions.write(trajectory + "\n")
            questions.flush()
            line = answers.readline()
        except (OSError, ValueError):  # the pipe is broken, or closed by `stop`
            line = ""
        if not line:
            raise DataError(
                f"A process that simulated {trajectory} ended with status {self._process.wait()}: was it killed, or is"
                " memory short? Repeat the call to continue; fewer workers take less memory."
            )
        answer: dict[str, Any] = json.loads(line)
        return answer

    def stop(self) -> None:
        """End it at once; a part that it writes has a temporary name."""
        self._process.kill()
        self._process.wait()


class _Texts(logging.Handler):
    """Keeps the texts of warnings, to be logged where the user sees them."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())


def serve() -> None:
    """Simulate what the standard input asks for, for the folder that the command line names, until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of a terminal; who started this one ends it
    answers, sys.stdout = sys.stdout, sys.stderr  # nothing that prints may mix with the answers
    warnings = _Texts()
    logging.getLogger("nmpm").addHandler(warnings)
    folder = Path(sys.argv[1])
    request = _request_from(json.loads(request_path(folder).read_text(encoding="utf-8")))
    worker = _OwnedWorker(request, folder)
    for line in sys.stdin:
        split, index = line.split()
        error, text = _outcome(worker, split, int(index))
        answers.write(json.dumps({"error": error, "text": text, "warnings": warnings.texts}) + "\n")
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
