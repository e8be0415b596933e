"""Progress of trainings and evaluations: steps, time left, loss and the latest validation error."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack
from datetime import timedelta
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.trainer.states import TrainerFn

from nmpm._support.progress import Advance, progress_bar
from nmpm.evaluation.figures import with_unit
from nmpm.training.budget import seconds_left, total_steps


class Progress(ProgressBar):
    """Shows progress without asking the device for anything but the loss, every `log_every_n_steps` steps.

    While training: steps, loss, MSE of the last validation's full rollouts, and, with `max_time`, which limit ends the
    training and when. While evaluating: batches. Nothing is shown by ranks other than 0.
    """

    def __init__(self) -> None:
        super().__init__()
        self._enabled = True
        self._open_bar = ExitStack()
        self._advance: Advance | None = None
        self._steps = 0  # that the bar shows
        self._first_step, self._start = 0, math.nan  # when this process began to train
        self._loss = self._error = ""

    @property
    def is_enabled(self) -> bool:
        """Whether a bar is shown, as `LightningModule.print` asks."""
        return self._enabled

    def disable(self) -> None:
        self._enabled = False

    def enable(self) -> None:
        self._enabled = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._start, self._first_step, self._steps = time.monotonic(), trainer.global_step, trainer.global_step
        self._open("training", total_steps(trainer), self._steps)

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        if self._enabled and trainer.global_step % max(1, trainer.log_every_n_steps) == 0:  # type: ignore[attr-defined]  # (Lightning sets it)
            loss = trainer.callback_metrics.get("train/loss")
            self._loss = "" if loss is None else f"loss {float(loss):.3g}"
        self._show(trainer, "training")

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.state.fn == TrainerFn.FITTING:
            self._show(trainer, "validating")
        else:
            self._open("validating", sum(trainer.num_val_batches))

    def on_validation_batch_end(self, trainer: Trainer, *_: Any) -> None:
        if trainer.state.fn != TrainerFn.FITTING:
            self.on_test_batch_end()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        error = trainer.callback_metrics.get("valid/mse")
        if trainer.state.fn != TrainerFn.FITTING:
            self.on_exception()
        elif error is not None and not trainer.sanity_checking:
            self._error = f"validation error {with_unit(float(error))}"
            self._show(trainer, "training")

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._open("testing", sum(trainer.num_test_batches))

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._open("predicting", sum(trainer.num_predict_batches))

    def on_test_batch_end(self, *_: Any) -> None:
        if self._advance is not None:
            self._advance()

    on_predict_batch_end: Any = on_test_batch_end

    def on_exception(self, *_: Any) -> None:
        """Close the bar, as at the end of a training, a test or a prediction."""
        self._open_bar.close()
        self._advance = None

    on_train_end: Any = on_exception
    on_test_end: Any = on_exception
    on_predict_end: Any = on_exception

    def _open(self, what: str, total: float, done: int = 0) -> None:
        if self._enabled:
            bar = progress_bar(what, int(total) if math.isfinite(total) else None, done)
            self._advance = self._open_bar.enter_context(bar)

    def _show(self, trainer: Trainer, doing: str) -> None:
        if self._advance is None:
            return
        new, self._steps = trainer.global_step - self._steps, trainer.global_step
        self._advance(", ".join(part for part in (doing, self._loss, self._error, self._end(trainer)) if part), new)

    def _end(self, trainer: Trainer) -> str:
        """Which limit ends the training, and when; empty where steps alone do, whose time the bar shows."""
        left, limit = seconds_left(trainer), "max_time"
        if math.isinf(left):
            return ""
        if taken := trainer.global_step - self._first_step:
            pace = (time.monotonic() - self._start) / taken
            steps_left = pace * (total_steps(trainer) - trainer.global_step)
            left, limit = min((left, limit), (steps_left, "max_steps"))
        return f"ends by {limit} in {timedelta(seconds=round(left))}"
