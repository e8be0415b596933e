"""Stop a training at Ctrl-C or SIGTERM, with a checkpoint of its last step."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Any

from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.trainer.states import TrainerFn

from nmpm._support.collectives import any_rank

RANKS_AGREE_EVERY = 16
"""Steps between exchanges of several ranks, which read back from the device."""


class StopOnSignal(Callback):
    """At SIGINT or SIGTERM writes a checkpoint after the running step, then raises KeyboardInterrupt.

    A second signal stops at once, and so does one during validation, before which a checkpoint is written. Under
    SLURM, SIGTERM is left to Lightning.

    Args:
        path: The checkpoint.

    Attributes:
        saved_step: Step of the last checkpoint written here; None before the first.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.saved_step: int | None = None
        self._step = -1
        self._requested = self._between_steps = False
        self._former: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self._step = trainer.global_step
        if threading.current_thread() is not threading.main_thread():
            return
        caught = [signal.SIGINT] if SLURMEnvironment.detect() else [signal.SIGINT, signal.SIGTERM]
        self._former = {kind: signal.signal(kind, self._handle) for kind in caught}

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,  # noqa: ARG002
        outputs: Any,  # noqa: ARG002
        batch: Any,  # noqa: ARG002
        batch_idx: int,  # noqa: ARG002
    ) -> None:
        if trainer.global_step == self._step:
            return  # between the batches of a step, whose gradients a checkpoint does not hold
        self._step = trainer.global_step
        if trainer.world_size == 1 or self._step % RANKS_AGREE_EVERY == 0:
            self._stop_if_requested(trainer)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        if trainer.state.fn != TrainerFn.FITTING or trainer.sanity_checking:
            return
        self._stop_if_requested(trainer)
        self._save(trainer)
        self._between_steps = True

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self._between_steps = False

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self._restore_handlers()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:  # noqa: ARG002
        self._restore_handlers()

    def _stop_if_requested(self, trainer: Trainer) -> None:
        if any_rank(self._requested, trainer.strategy.root_device):
            self._save(trainer)
            raise KeyboardInterrupt

    def _save(self, trainer: Trainer) -> None:
        trainer.save_checkpoint(self.path, weights_only=False)
        self.saved_step = trainer.global_step

    def _handle(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002
        if self._requested or self._between_steps:
            raise KeyboardInterrupt
        self._requested = True

    def _restore_handlers(self) -> None:
        for kind, former in self._former.items():
            signal.signal(kind, former)
        self._former = {}
