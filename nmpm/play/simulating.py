"""The process that simulates beside the emulator; it needs no torch."""

from __future__ import annotations

import time
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import NmpmError
from nmpm.sim import InitialState, Preset


class Simulated(NamedTuple):
    """A frame of a run.

    Args:
        run: Number of the run.
        frame: From 1.
        position: (N, D) in length.
        seconds: Time that it took.
        problem: What ended the run; then there is no position.
    """

    run: int
    frame: int
    position: NDArray[np.float32]
    seconds: float
    problem: str = ""


def simulate_for(pipe: Connection) -> None:
    """Simulate the states that come through a pipe, (run, preset, state), and send frames until the next one comes."""
    try:
        while True:
            run, preset, start = pipe.recv()
            _run(pipe, run, preset, start)
    except (EOFError, OSError, KeyboardInterrupt):
        return  # the other end is closed


def _run(pipe: Connection, run: int, preset: Preset, start: InitialState) -> None:
    """Send frames until something comes."""
    frames, number = preset.stream_from(start), 0
    none = np.empty((0, len(preset.box)), np.float32)
    while not pipe.poll():
        number, started = number + 1, time.perf_counter()
        try:
            position = next(frames).astype(np.float32)
        except NmpmError as error:
            pipe.send(Simulated(run, number, none, 0.0, str(error)))
            return
        pipe.send(Simulated(run, number, position, time.perf_counter() - started))
