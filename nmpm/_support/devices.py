"""Devices by name."""

from __future__ import annotations

import torch

from nmpm.errors import ConfigError

DEVICES = ("auto", "cpu", "cuda", "mps")
"""Names that `--device` takes."""


def find_device(name: torch.device | str = "auto") -> torch.device:
    """The device of a name; for "auto" a CUDA GPU where there is one, else an Apple GPU, else the CPU.

    Raises:
        ConfigError: if there is no such device here.
    """
    available = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True, "meta": True}
    if name == "auto":
        return torch.device(next(kind for kind, there in available.items() if there))
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"device {name!r} is not one of {', '.join(DEVICES)}.") from error
    if not available.get(device.type, False):
        raise ConfigError(f"There is no device {name!r} here; there is {find_device('auto').type}.")
    return device
