"""Timing and memory for the benchmarks: alternating runs, medians with spread, clocks that wait for the GPU.

Compare within one run only: all setups alternate, so that they meet the same machine. Each runs in a process of its
own where the other setups' memory would matter.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

import torch

from nmpm._support.atomic import atomic_write
from nmpm._support.machine import DEVICES, find_device
from nmpm._support.messages import counted
from nmpm.errors import ConfigError
from nmpm.evaluation.machine import Action, Clock, describe_device, peak_bytes, wall_clock

__all__ = ["peak_bytes", "wall_clock"]  # the scripts import them from here
K = TypeVar("K")

WARM_UP = 2
"""Runs of each action before the timed ones: kernels are chosen and memory is allocated in them."""


@dataclass(frozen=True)
class Spread:
    """Seconds of repeated runs.

    Args:
        median, least, most: Of the runs.
    """

    median: float
    least: float
    most: float

    @classmethod
    def of(cls, seconds: list[float]) -> Spread:
        """Of at least one run."""
        return cls(statistics.median(seconds), min(seconds), max(seconds))

    def format(self, unit: float = 1e-3) -> str:
        """The text "median (least-most)", in units of this many seconds."""
        return f"{self.median / unit:.4g} ({self.least / unit:.4g}-{self.most / unit:.4g})"


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser whose help shows a script's docstring as it is."""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)


def add_device_option(parser: argparse.ArgumentParser) -> None:
    """Add `--device`, parsed to a `torch.device` that exists here."""
    parser.add_argument(
        "--device",
        type=_parse_device,
        default="auto",
        metavar=f"{{{','.join(DEVICES)}}}",
        help="where to compute (default: auto, a GPU where there is one)",
    )


def _parse_device(name: str) -> torch.device:
    try:
        return find_device(name)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def make_timing_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser with `--device`, `--threads` and `--json`."""
    parser = make_parser(description)
    add_device_option(parser)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    return parser


def clock_for(device: torch.device) -> Clock:
    """CPU time on the CPU, which other programs disturb less than wall time; wall time on a GPU."""
    return time.process_time if device.type == "cpu" else wall_clock


def time_run(action: Action, clock: Clock = wall_clock) -> float:
    """Seconds that an action takes."""
    start = clock()
    action()
    return clock() - start


def time_alternating(
    actions: Mapping[K, Action], rounds: int, clock: Clock = wall_clock, warm_up: int = WARM_UP
) -> dict[K, list[float]]:
    """Seconds of each action's runs in this process, one run of each per round.

    Args:
        actions: What to time.
        rounds: Timed runs of each.
        clock: Reads the time.
        warm_up: Rounds before the timed ones.
    """
    return _alternate({key: lambda a=action: time_run(a, clock) for key, action in actions.items()}, rounds, warm_up)  # type: ignore[misc]


def time_in_processes(makers: Mapping[str, Callable[[], Action]], rounds: int, threads: int) -> dict[str, list[float]]:
    """As `time_alternating`, each action in a process of its own; only one process works at a time.

    Args:
        makers: Make the actions in their processes; they must be picklable.
        rounds: Timed runs of each.
        threads: Of torch in each process.

    Raises:
        EOFError: if a process fails; its traceback is on stderr.
    """
    context = multiprocessing.get_context("spawn")
    pipes: dict[str, Connection] = {}
    for name, maker in makers.items():
        pipes[name], theirs = context.Pipe()
        context.Process(target=_serve, args=(theirs, maker, threads), daemon=True).start()
        theirs.close()  # so that a process that fails ends the wait below
        pipes[name].recv()  # the action is made

    def run(pipe: Connection) -> float:
        pipe.send("run")
        return float(pipe.recv())

    seconds = _alternate({name: lambda p=pipe: run(p) for name, pipe in pipes.items()}, rounds, WARM_UP)  # type: ignore[misc]
    for pipe in pipes.values():
        pipe.send("end")
    return seconds


def _serve(pipe: Connection, maker: Callable[[], Action], threads: int) -> None:
    torch.set_num_threads(threads)
    action = maker()
    pipe.send("made")
    while pipe.recv() == "run":
        pipe.send(time_run(action))


def _alternate(timers: Mapping[K, Callable[[], float]], rounds: int, warm_up: int) -> dict[K, list[float]]:
    seconds: dict[K, list[float]] = {key: [] for key in timers}
    for turn in range(warm_up + rounds):
        for key, timer in timers.items():
            spent = timer()
            if turn >= warm_up:
                seconds[key].append(spent)
    return seconds


def run_in_process(action: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Run a picklable action in a new process, so that no earlier memory counts, and return its result."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(action)


def measure_limits(device: torch.device, threads: int) -> dict[str, float]:
    """What the machine reaches at best: GFLOP/s of matrix products, GB/s of copies (read and written)."""
    torch.set_num_threads(threads)
    figures = {}
    side, length = (2048, 2**26) if device.type == "cpu" else (8192, 2**28)
    for dtype in (torch.float32, torch.bfloat16):
        matrix = torch.randn(side, side, device=device, dtype=dtype)
        best = min(time_run(lambda m=matrix: m @ m) for _ in range(8))  # type: ignore[misc]
        figures[f"gflops_{str(dtype).removeprefix('torch.')}"] = 2e-9 * side**3 / best
    source = torch.randn(length, device=device)
    target = torch.empty_like(source)
    best = min(time_run(lambda: target.copy_(source)) for _ in range(8))
    return figures | {"copy_gb_per_s": 2e-9 * source.numel() * source.element_size() / best}


def describe_machine(device: torch.device, threads: int) -> str:
    """Processor or GPU, threads, and torch's version."""
    parts = [describe_device(device), *([counted(threads, "thread")] if device.type == "cpu" else [])]
    return ", ".join([*parts, f"torch {torch.__version__}"])


def write_json(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Write figures, if a path is given; dataclasses as mappings, devices as their names."""
    if path is not None:
        with atomic_write(path) as part:
            part.write_text(json.dumps(figures, indent=1, default=_plain) + "\n", encoding="utf-8")


def _plain(value: object) -> object:
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)
