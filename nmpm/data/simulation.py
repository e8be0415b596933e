"""Simulated trajectories: their seeds, and several at a time, each in a process.

Threads would share the interpreter's lock, which a simulator's kernels release for a tenth of a millisecond at a time:
of many threads most would wait for it. The processes are loky's, which do not import the caller's script.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import TypeVar

import numpy as np
from joblib.externals.loky import ProcessPoolExecutor, process_executor

from nmpm.errors import DataError, UnstableError
from nmpm.sim import Preset
from nmpm.sim.state import SimulatedTrajectory

DRAWS = 5
"""Seeds tried for one trajectory; if all are unstable, the preset is at fault."""
FRAMES_PER_PROCESS = 1000
"""Least frames for which a process is started: these take about three seconds, as does its start."""
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"}
"""Of a process; nothing is imported from the working directory that this process would not import from there."""
_POLL_SECONDS = 0.2

_log = logging.getLogger(__name__)

T = TypeVar("T")


def derive_seed(*entropy: int) -> int:
    """A seed that depends on all the numbers."""
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0] >> np.uint64(1))


def seed_of_draw(entropy: tuple[int, ...], draw: int) -> int:
    """The seed of a trajectory after `draw` seeds before it were unstable.

    Args:
        entropy: Numbers that identify the trajectory: the dataset's seed, and its split and index or the like.
        draw: 0 for the first seed.
    """
    return derive_seed(*entropy, draw) if draw else derive_seed(*entropy)


def try_seeds(
    entropy: tuple[int, ...], simulate: Callable[[int], T], warn: Callable[[str], object] = _log.warning
) -> T:
    """The simulation from the first stable seed of a trajectory.

    Args:
        entropy: As for `seed_of_draw`.
        simulate: Simulates from a seed.
        warn: Called for each unstable seed, with a message.

    Raises:
        UnstableError: if none of `DRAWS` seeds stays stable.
    """
    for draw in range(DRAWS):
        seed = seed_of_draw(entropy, draw)
        try:
            return simulate(seed)
        except UnstableError as error:
            warn(f"Another seed takes the place of {seed}, which is unstable. {error}")
            last = error
    raise UnstableError(f"{DRAWS} seeds in a row are unstable; the last: {last}") from last


def simulate_all(
    preset: Preset, entropies: Sequence[tuple[int, ...]], workers: int, check: Callable[[], object] = lambda: None
) -> Generator[tuple[int, SimulatedTrajectory], None, None]:
    """Yields the index and the trajectory of each of `entropies` as they are finished, of the first stable seed each.

    Closing the iterator ends the processes at once. They write nothing, ignore Ctrl-C, and end with this process
    however it ends. Little work is done in this process instead, one trajectory after the other.

    Args:
        preset: The family of scenes.
        entropies: As for `seed_of_draw`, of each trajectory.
        workers: Processes at most.
        check: Called several times a second; what it raises ends the simulation.

    Raises:
        UnstableError: if no seed of a trajectory stays stable.
        ConfigError: if no initial state fits into the box.
        DataError: if a process ends before its trajectory is finished.
    """
    processes = min(workers, len(entropies), len(entropies) * preset.frames // FRAMES_PER_PROCESS)
    if processes > 1:
        yield from _simulate_in_processes(preset, entropies, processes, check)
        return
    for index, entropy in enumerate(entropies):
        yield index, try_seeds(entropy, lambda seed: preset.simulate(seed, lambda _: check()))


def _simulate_in_processes(
    preset: Preset, entropies: Sequence[tuple[int, ...]], processes: int, check: Callable[[], object]
) -> Generator[tuple[int, SimulatedTrajectory], None, None]:
    resource_tracker.ensure_running()  # its start would end `_blocked_interrupts`
    executor = ProcessPoolExecutor(processes, initializer=_end_with, initargs=(os.getpid(),), env=_ENVIRONMENT)
    queue, waiting = deque(enumerate(entropies)), dict[Future[tuple[SimulatedTrajectory, list[str]]], int]()
    try:
        while queue or waiting:
            with _blocked_interrupts():
                while queue and len(waiting) <= processes:  # one more, so that no process waits
                    index, entropy = queue.popleft()
                    waiting[executor.submit(_simulate, preset, entropy)] = index
            check()
            if process_executor._global_shutdown:  # the program ends, and would wait for all that is submitted
                raise SystemExit
            for future in wait(waiting, _POLL_SECONDS, FIRST_COMPLETED).done:
                trajectory, warnings = future.result()
                for text in warnings:
                    _log.warning("%s", text)
                yield waiting.pop(future), trajectory
    except BrokenProcessPool as error:
        raise DataError(
            "A process that simulates has ended: was it killed, or is memory short? Repeat the call to continue; fewer"
            " workers take less memory."
        ) from error
    finally:
        executor.shutdown(kill_workers=True)


@contextmanager
def _blocked_interrupts() -> Iterator[None]:
    """Processes that are started meanwhile never see Ctrl-C, which reaches all processes of a terminal."""
    former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def _end_with(owner: int) -> None:
    """Let this process end when the one that started it has ended, even by kill -9."""

    def watch() -> None:
        while os.getppid() == owner:
            time.sleep(_POLL_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _simulate(preset: Preset, entropy: tuple[int, ...]) -> tuple[SimulatedTrajectory, list[str]]:
    """A trajectory, and warnings to be logged where the user sees them."""
    warnings: list[str] = []
    return try_seeds(entropy, preset.simulate, warnings.append), warnings
