"""Devices by name; torch is imported where a device is looked for."""

from __future__ import annotations

import platform
import re
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm._support.messages import counted, one_line
from nmpm.errors import ConfigError

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
    return device.type


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
