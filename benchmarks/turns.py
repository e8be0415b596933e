"""Fair timing: every form in a process of its own, one at a time, in turns; medians with spread; the machine's limits.

Comparisons hold within one run only. A process of its own, so that no form profits from another's warm memory.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import multiprocessing
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

import torch

from nmpm._support.atomic import replacing

Action = Callable[[], object]
K = TypeVar("K")


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

    def shown(self, unit: float = 1e-3) -> str:
        """In units of so many seconds, as "median (least-most)"."""
        return f"{self.median / unit:.4g} ({self.least / unit:.4g}-{self.most / unit:.4g})"


def arguments(about: str | None) -> argparse.ArgumentParser:
    """The options that every benchmark of forms and sizes has."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    return parser


def in_turns(makers: Mapping[str, Callable[[], Action]], rounds: int, threads: int) -> dict[str, list[float]]:
    """Seconds of each action's runs, one run of each per round; the first two rounds warm up and are not counted.

    Args:
        makers: Make the actions, each in its own process; they must be picklable.
        rounds: How many to count.
        threads: Of torch, in each process; only one process works at a time.
    """
    context = multiprocessing.get_context("spawn")
    pipes: dict[str, Connection] = {}
    for name, maker in makers.items():
        pipes[name], theirs = context.Pipe()
        context.Process(target=_serve, args=(theirs, maker, threads), daemon=True).start()
        pipes[name].recv()  # made: from here on it only waits
    seconds: dict[str, list[float]] = {name: [] for name in makers}
    for turn in range(rounds + 2):
        for name, pipe in pipes.items():
            pipe.send("run")
            spent = pipe.recv()
            if turn >= 2:
                seconds[name].append(spent)
    for pipe in pipes.values():
        pipe.send("end")
    return seconds


def _serve(pipe: Connection, maker: Callable[[], Action], threads: int) -> None:
    torch.set_num_threads(threads)
    action = maker()
    pipe.send("made")
    while pipe.recv() == "run":
        pipe.send(timed(action))


def timed(action: Action) -> float:
    """Seconds that an action takes, on a GPU until all of it is done."""
    start = time.perf_counter()
    action()
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def processor_time(action: Action) -> float:
    """Seconds of the processor: what else runs on the machine counts less than in those of the clock."""
    start = time.process_time()
    action()
    return time.process_time() - start


def in_one_process(
    actions: Mapping[K, Action], rounds: int, seconds: Callable[[Action], float] = timed
) -> dict[K, list[float]]:
    """Seconds of each action's runs, one run of each per round, all here; the first round is not counted."""
    spent: dict[K, list[float]] = {key: [] for key in actions}
    for turn in range(rounds + 1):
        for key, action in actions.items():
            found = seconds(action)
            if turn:
                spent[key].append(found)
    return spent


def most_held(action: Action, device: str) -> float:
    """Bytes that an action holds at most, beyond what was held: tensors on a GPU, else the process (on Linux)."""
    if device == "cuda":
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        action()
        return float(torch.cuda.max_memory_allocated() - before)
    ctypes.CDLL(None).malloc_trim(0)  # what was freed is given back, or the action would reuse it unseen
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before = _status("VmRSS")
    action()
    return float(_status("VmHWM") - before)


def _status(name: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(name))


def alone(action: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What an action returns, run in a process of its own, so that its memory is its own; it must be picklable."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(action)


def ceilings(device: str, threads: int) -> dict[str, float]:
    """What the machine reaches on work made for it: GFLOP/s of matrix products, GB/s of copies (read and written)."""
    torch.set_num_threads(threads)
    figures = {}
    for dtype in (torch.float32, torch.bfloat16):
        side = 8192 if device == "cuda" else 2048
        matrix = torch.randn(side, side, device=device, dtype=dtype)
        best = min(timed(lambda m=matrix: m @ m) for _ in range(8))  # type: ignore[misc]
        figures[f"gflops_{str(dtype).removeprefix('torch.')}"] = 2e-9 * side**3 / best
    source = torch.randn(2**28 if device == "cuda" else 2**26, device=device)
    target = torch.empty_like(source)
    best = min(timed(lambda: target.copy_(source)) for _ in range(8))
    return figures | {"copy_gb_per_s": 2e-9 * source.numel() * source.element_size() / best}


def machine(device: str, threads: int) -> str:
    """What this ran on, in words."""
    if device == "cuda":
        return f"{torch.cuda.get_device_name()}, torch {torch.__version__}"
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text(encoding="utf-8").splitlines() if cpu.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor()}, {threads} threads, torch {torch.__version__}"


def write(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Figures as JSON, if a path is given."""
    if path is not None:
        with replacing(path) as part:
            part.write_text(json.dumps(figures, indent=1, default=asdict) + "\n", encoding="utf-8")
