"""The machine that measures: its name, clocks that wait for the GPU, and the peak of memory."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from nmpm._support.machine import device_name, processor_name

Action = Callable[[], object]
Clock = Callable[[], float]


def synchronize() -> None:
    """Wait until the GPU has finished; does nothing where none is in use."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    if torch.backends.mps.is_available():
        torch.mps.synchronize()


def wall_clock() -> float:
    """Seconds, read once the GPU has finished."""
    synchronize()
    return time.perf_counter()


def clock_for(device: torch.device) -> tuple[str, Clock]:
    """The name of the clock that one thread's computation is timed by, and the clock: CPU time, wall time on GPUs.

    Other programs disturb CPU time less.
    """
    return ("CPU time", time.thread_time) if device.type == "cpu" else ("wall time", wall_clock)


def peak_bytes(action: Action, device: torch.device) -> float:
    """Peak memory of an action, beyond what was allocated before it, in bytes.

    On CUDA that of torch's tensors, on the CPU that of the process. NaN where there is no such counter: on MPS, and on
    systems other than Linux.
    """
    if device.type == "cuda":
        synchronize()
        allocated = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        action()
        synchronize()
        return float(torch.cuda.max_memory_allocated(device) - allocated)
    if device.type != "cpu" or not Path("/proc/self/clear_refs").exists():
        action()
        return float("nan")
    ctypes.CDLL(None).malloc_trim(0)  # otherwise the action reuses freed memory, which would not be counted
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before = _process_status("VmRSS")
    action()
    return float(_process_status("VmHWM") - before)


def _process_status(name: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(name))


def is_machine_failure(error: BaseException) -> bool:
    """Whether an error was caused by the machine: memory, a file or a missing package. It may succeed the next time."""
    cause = error.__cause__
    if isinstance(cause, (MemoryError, OSError, ImportError, torch.OutOfMemoryError)):
        return True
    # torch raises a plain RuntimeError where the host's memory runs out.
    return cause is not None and ("can't allocate memory" in str(cause) or is_machine_failure(cause))


def describe_device(device: torch.device) -> str:
    """Name of the processor or GPU."""
    return processor_name() if device.type == "cpu" else device_name(device)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch's operations use one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
