"""What this machine has: devices by name, the processor, and memory; torch is imported where a device is looked for."""

from __future__ import annotations

import math
import platform
import re
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm._support.messages import counted, one_line
from nmpm.errors import ConfigError, DataError

if TYPE_CHECKING:
    import torch
    from torch import Tensor


DEVICES = ("auto", "cpu", "cuda", "mps")
"""Names that `--device` takes; "cuda:1" means the second GPU."""


def check_device_name(name: str) -> None:
    """Raise ConfigError for a text that names no device, on whatever machine."""
    if re.fullmatch(rf"({'|'.join(DEVICES)})(:[0-9]+)?", name) is None:
        raise ConfigError(f"--device {one_line(name, 60)}: it is not one of {', '.join(DEVICES)}.")


def find_device(name: torch.device | str = "auto") -> torch.device:
    """The device of a name; for "auto" a CUDA GPU if there is one, else an Apple GPU, else the CPU.

    Raises:
        ConfigError: if this machine does not have the device.
    """
    import torch

    counts = {
        "cuda": torch.cuda.device_count() if torch.cuda.is_available() else 0,
        "mps": int(torch.backends.mps.is_available()),
        "cpu": 1,
        "meta": 1,
    }
    if name == "auto":
        return torch.device(next(kind for kind, count in counts.items() if count))
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError) as error:
        raise ConfigError(f"device {one_line(repr(name), 60)} is not one of {', '.join(DEVICES)}.") from error
    if (device.index or 0) >= counts.get(device.type, 0):
        here = [kind if count == 1 else f"{kind}:0 … {count - 1}" for kind, count in counts.items() if count]
        raise ConfigError(
            f"This machine has no device {str(device)!r}; it has {', '.join(h for h in here if h != 'meta')}."
        )
    return device


def device_name(device: torch.device, threads: int | None = None) -> str:
    """The model of a device: of the GPU, or of the processor with the number of threads, by default those of torch."""
    import torch

    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if device.type == "cpu":
        return f"{processor_name()}, {counted(threads or torch.get_num_threads(), 'thread')}"
    return f"Apple GPU ({platform.processor()})" if device.type == "mps" else device.type


def computes_bfloat16(device: torch.device) -> bool:
    """Whether a device has instructions for convolutions in bfloat16, and torch uses them.

    An x86 CPU has with AVX512_BF16. With other AVX-512, oneDNN emulates them, and a training step takes 1.7 times as
    long as in float32; without, torch's own loops take 8 to 10 times as long.
    """
    import torch

    if device.type != "cpu":
        return True
    if not torch.backends.mkldnn.is_available() or not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return False
    return not torch.cpu._is_avx2_supported() or torch.cpu._is_avx512_bf16_supported()  # (Arm has no AVX2)


def join_hardware(*names: str) -> str:
    """Results of `device_name`, or of this function, as one text that names each device once, in their order."""
    return "; ".join(dict.fromkeys(part for name in names for part in name.split("; ") if part))


def processor_name() -> str:
    """The model of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def copy_to(values: Tensor, device: torch.device) -> Tensor:
    """Values on a device; a copy from the CPU to a GPU does not wait for the kernels that are queued there."""
    pinned = device.type == "cuda" and values.device.type == "cpu"
    return values.pin_memory().to(device, non_blocking=True) if pinned else values.to(device)


_CGROUP = Path("/sys/fs/cgroup")
_ALWAYS = 2**28
"""Bytes for which nobody is asked."""


def check_fits(frames: int, particles: int, values: int, where: str) -> None:
    """Refuses, with a DataError, an array of so many values per particle and frame for which memory does not suffice.

    Files of few bytes can ask for it, by frames that are far apart, or particles that are in few frames.
    """
    size = 4 * frames * particles * max(values, 1)
    if size > _ALWAYS and size > free_memory():
        raise DataError(
            f"{where}: {frames:,} frames of {particles:,} particles need {size / 2**30:,.1f} GiB of memory,"
            f" {free_memory() / 2**30:.1f} are free. Cut the run along time, or leave particles out."
        )


def free_memory() -> float:
    """Bytes of main memory that are free, within the container's limit; infinite where the system does not say."""
    free = [math.inf]
    with suppress(OSError):
        sizes = dict(line.partition(":")[::2] for line in Path("/proc/meminfo").read_text().splitlines())
        if "MemAvailable" in sizes:
            free.append(1024.0 * float(sizes["MemAvailable"].split()[0]))
    with suppress(OSError):
        limit, used = ((_CGROUP / f"memory.{name}").read_text().strip() for name in ("max", "current"))
        cached = dict(line.split() for line in (_CGROUP / "memory.stat").read_text().splitlines())
        if limit != "max":
            free.append(float(limit) - float(used) + float(cached.get("inactive_file", 0)))
    return min(free)
