"""Read checkpoints as tensors and plain data, without executing anything in them; write them atomically."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from torch import Tensor

from nmpm._support.atomic import atomic_write
from nmpm._support.digests import weights_digest
from nmpm._support.messages import one_line
from nmpm.errors import DataError, NmpmError
from nmpm.training.module import EmulatorModule

FORMER_ARGUMENTS = frozenset({"horizons", "emd"})
"""Hyperparameters of version 0.1.0 that the model no longer has: metrics are now chosen for each evaluation."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint beside its place, then renames it.

    Lightning writes into the system's temporary folder, from where, on another file system, a kill leaves half a file.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:  # noqa: ARG002
        if "://" in str(path):
            super().save_checkpoint(checkpoint, path)
            return
        with atomic_write(Path(path)) as part:
            torch.save(checkpoint, part)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint onto the CPU, without executing anything in it.

    Raises:
        DataError: if it is missing, damaged, or holds more than tensors and plain data.
    """
    if not path.is_file():
        raise DataError(f"{path}: there is no such checkpoint.")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch's readers raise many types on damaged files
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise DataError(
            f"{path} cannot be read as a checkpoint: it is damaged, or holds more than tensors and plain data, which"
            f" is never executed. Use another, such as best.ckpt or last.ckpt beside it. ({reason})"
        ) from error
    if not isinstance(content, dict) or "state_dict" not in content:
        raise DataError(f"{path} is not a checkpoint of a training: it has no state_dict.")
    _check_digest(content, path)
    return content


def _check_digest(content: dict[str, Any], path: Path) -> None:
    """Make sure that the weights are those that were saved; checkpoints of version 0.1.0 state no digest."""
    stated, weights = content.get("nmpm_digest"), content["state_dict"]
    if stated is None:
        return
    whole = isinstance(weights, dict) and all(isinstance(values, Tensor) for values in weights.values())
    if not whole or weights_digest(weights) != stated:
        raise DataError(
            f"{path} is damaged: its weights are not those that were saved. Use another checkpoint, such as best.ckpt"
            " or last.ckpt beside it."
        )


def load_module(path: Path) -> EmulatorModule:
    """Load the module of a checkpoint onto the CPU.

    Raises:
        DataError: if the file cannot be read, or is not a checkpoint of an emulator.
        ConfigError: if a newer nmpm wrote it, or it names an unknown part.
    """
    content = read_checkpoint(path)
    stored = content.get("hyper_parameters", {})
    if not isinstance(stored, dict) or not isinstance(stored.get("scene", {}), dict):
        raise DataError(f"{path} is not a checkpoint of an emulator: its hyperparameters are not named values.")
    arguments = {key: value for key, value in stored.items() if key not in FORMER_ARGUMENTS}
    try:
        module = EmulatorModule(**arguments)
        module.on_load_checkpoint(content)
        module.load_state_dict(content["state_dict"])
    except NmpmError:
        raise
    except Exception as error:  # hyperparameters of a foreign or damaged file may have any type and value
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise DataError(f"{path} is not a checkpoint of an emulator of this version ({reason}).") from error
    return module
