"""Write the checkpoint that a training goes on from, whenever it may be needed, and stop at Ctrl-C or SIGTERM."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from nmpm._support.collectives import any_rank

RANKS_AGREE_EVERY = 16
"""Steps between exchanges of several ranks, which read back from the device."""


class LastCheckpoint(ModelCheckpoint):
    """A ModelCheckpoint that also writes before and after each validation, at the training's last step and at signals.

    After a validation it has to be written after the best checkpoint: a process that is killed between the two
    validates again when it goes on. At SIGINT or SIGTERM it writes a checkpoint after the running step, then raises
    KeyboardInterrupt. A second signal stops at once, and so does one during validation. Under SLURM, SIGTERM is left to
    Lightning.
    """

    _step = -1
    _running = _requested = _validating = False
    _former: dict[signal.Signals, Any]

    @property
    def saved_step(self) -> int:
        """Step of the last checkpoint written here; 0 before the first."""
        return self._last_global_step_saved

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing is taken over: paths may have changed."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_start(trainer, pl_module)
        self._step, self._running, self._former = trainer.global_step, True, {}
        if threading.current_thread() is not threading.main_thread():
            return
        caught = [signal.SIGINT] if SLURMEnvironment.detect() else [signal.SIGINT, signal.SIGTERM]
        self._former = {kind: signal.signal(kind, self._handle) for kind in caught}

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        if trainer.global_step == self._step:
            return  # between the batches of a step, whose gradients a checkpoint does not hold
        self._step = trainer.global_step
        if trainer.world_size == 1 or self._step % RANKS_AGREE_EVERY == 0:
            self._stop_if_requested(trainer)
        if _is_last_step(trainer):
            self._save(trainer)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        if self._running:
            self._stop_if_requested(trainer)
            self._save(trainer)
            self._validating = True

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        if self._running:
            self._validating = False
            self._save(trainer)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_end(trainer, pl_module)
        self._stop_handling()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        super().on_exception(trainer, pl_module, exception)
        self._stop_handling()

    def _stop_if_requested(self, trainer: Trainer) -> None:
        if any_rank(self._requested, trainer.strategy.root_device):
            self._save(trainer)
            raise KeyboardInterrupt

    def _save(self, trainer: Trainer) -> None:
        if not trainer.fit_loop._should_accumulate():
            self._save_checkpoint(trainer, self.format_checkpoint_name(self._monitor_candidates(trainer)))

    def _handle(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002
        if self._requested or self._validating:
            raise KeyboardInterrupt
        self._requested = True

    def _stop_handling(self) -> None:
        self._running = False
        for kind, former in getattr(self, "_former", {}).items():
            signal.signal(kind, former)
        self._former = {}


def _is_last_step(trainer: Trainer) -> bool:
    """Whether steps, epochs or time are over: what follows must not make the training lose its last steps."""
    loop = trainer.fit_loop.epoch_loop
    last_epoch = trainer.current_epoch + 1 == trainer.max_epochs
    return (
        trainer.global_step == trainer.max_steps
        or trainer.should_stop
        or (last_epoch and loop._num_ready_batches_reached())
    )
