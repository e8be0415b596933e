"""Which precision a device trains in: bfloat16 pays where there are instructions for it, and only there."""

from __future__ import annotations

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.utilities import rank_zero_warn

from nmpm._support.devices import computes_bfloat16

BFLOAT16 = frozenset({"bf16", "bf16-mixed"})
"""Lightning's names of mixed precision with bfloat16."""
FLOAT32 = "32-true"


def fitting_precision(precision: str, device: torch.device) -> str:
    """The precision itself, or float32 in place of mixed bfloat16 on a device without instructions for that."""
    return FLOAT32 if precision in BFLOAT16 and not computes_bfloat16(device) else precision


def warn_of_slow_precision(trainer: Trainer) -> None:
    """Say so where a trainer is about to train in bfloat16 without instructions for it."""
    if fitting_precision(str(trainer.precision), trainer.strategy.root_device) != trainer.precision:
        rank_zero_warn(
            f"This processor has no instructions for bfloat16, without which {trainer.precision} takes many times as"
            f' long as float32: give the trainer precision="{FLOAT32}".'
        )
