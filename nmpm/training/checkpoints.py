"""Checkpoints read as tensors and plain data: nothing in them is run, and a damaged one is named."""

from __future__ import annotations

import pickle
from pathlib import Path

import torch

from nmpm.errors import DataError
from nmpm.training.module import EmulatorModule


def check_checkpoint(path: Path) -> None:
    """Make sure that a file can be read as a checkpoint.

    Raises:
        DataError: if it is missing, damaged, or holds more than tensors and plain data.
    """
    if not path.is_file():
        raise DataError(f"{path}: there is no such checkpoint.")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        reason = str(error).strip().split("\n")[0]
        raise DataError(
            f"{path} cannot be read as a checkpoint: it is damaged, or holds more than tensors and plain data, which is"
            f" never run. Take another, such as best.ckpt or last.ckpt beside it. ({type(error).__name__}: {reason})"
        ) from error
    if not isinstance(content, dict) or "state_dict" not in content:
        raise DataError(f"{path} is no checkpoint of a training: it holds no state_dict.")


def load_module(path: Path) -> EmulatorModule:
    """The module of a checkpoint, on the CPU.

    Raises:
        DataError: if the file cannot be read, or is not a checkpoint of an emulator.
    """
    check_checkpoint(path)
    try:
        return EmulatorModule.load_from_checkpoint(path, map_location="cpu", weights_only=True)
    except (RuntimeError, TypeError, KeyError) as error:
        raise DataError(f"{path} is not a checkpoint of an emulator of this version: {error}") from error
