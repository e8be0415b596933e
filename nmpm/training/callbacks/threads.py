"""Use a CPU's cores: a batch in parts that a thread each computes, or threads inside of operations."""

from __future__ import annotations

from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from nmpm._support.machine import processor_name
from nmpm._support.threads import ThreadChoice, usable_cores
from nmpm.particles import Window
from nmpm.training.backpropagation import MOST_PARTS
from nmpm.training.module import EmulatorModule


class Threads(Callback):
    """Splits batches in as many parts as there are cores, and measures whether one thread is faster than all.

    The number of parts is in checkpoints: a training that goes on elsewhere ends with the same weights. Without several
    windows to a batch, the threads are those inside of torch's operations.

    Args:
        stated: Number of threads that the user asks for; None to measure.
    """

    def __init__(self, stated: int | None) -> None:
        self.stated, self._parts, self._printed = stated, 0, False
        self.choice = ThreadChoice(stated, self._apply)
        self._module: EmulatorModule | None = None
        self._in_parts = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if not isinstance(pl_module, EmulatorModule) or trainer.strategy.root_device.type != "cpu":
            return
        self.choice, self._module = self._make_choice(trainer), pl_module
        if self.stated or not self._parts:
            self._parts = min(self.choice.most, MOST_PARTS)
        pl_module.parts, pl_module.threads = self._parts, self.choice.most
        torch.set_num_threads(1)

    def describe(self, trainer: Trainer) -> str:
        """The processor and the threads of a trainer's processes, in words."""
        ranks, choice = trainer.world_size, self._make_choice(trainer)
        return f"{processor_name()}, {choice}" if ranks == 1 else f"{processor_name()}, {ranks} processes of {choice}"

    def _make_choice(self, trainer: Trainer) -> ThreadChoice:
        """Processes of one machine share its cores; their steps wait for one another, so that none measures."""
        ranks = trainer.world_size // trainer.num_nodes
        share = max(1, usable_cores() // ranks) if ranks > 1 else None
        return ThreadChoice(self.stated or share, self._apply)

    def state_dict(self) -> dict[str, Any]:
        return {"parts": self._parts}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if self.stated:
            return
        self._parts = int(state_dict["parts"]) or self._parts  # 0 where it was trained on a GPU
        if self._module is not None:
            self._module.parts = self._parts

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if self._module is not None:
            self._in_parts = isinstance(batch, Window) and len(self._module.rows(batch)) > 1
            self.choice.start()

    def on_train_batch_end(self, *_: Any) -> None:
        if self._module is None:
            return
        self.choice.stop()
        if self.choice.seconds and not self._printed:
            self._printed = True
            times = "; ".join(f"{1e3 * seconds:.0f} ms by {n}" for n, seconds in self.choice.seconds.items())
            self._module.print(f"Threads: {self.choice.threads} (a step takes {times}).")

    def _apply(self, threads: int) -> None:
        """Let so many threads compute the parts of a batch; where it is in one part, its operations."""
        if self._module is not None and self._in_parts:
            self._module.threads = threads
        else:
            torch.set_num_threads(threads)
