"""One line of progress: steps, time left, loss and the latest validation error."""

from __future__ import annotations

import math
import os
import sys
from datetime import timedelta
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.callbacks.progress.tqdm_progress import Tqdm
from lightning.pytorch.trainer.states import TrainerFn

from nmpm.evaluation.figures import with_unit
from nmpm.training.budget import TimeLeft, time_left, total_steps

SCALE = 1000
"""Of the bar's length: it shows the share that is over, of steps or time, whichever is further."""

LOG_FILE_SECONDS = 60.0
"""Seconds between lines where the output is a file."""


class Progress(ProgressBar):
    """Shows progress without asking the device for anything but the loss, every `log_every_n_steps` steps.

    While training: steps taken and to take, time left and which limit ends it, loss, and the last validation's
    full-rollout MSE. While evaluating: batches. Nothing is shown by ranks other than 0.
    """

    def __init__(self) -> None:
        super().__init__()
        self._enabled = True
        self._bar: Tqdm | None = None
        self._doing = self._loss = self._valid = ""
        self._first_step = 0

    @property
    def is_enabled(self) -> bool:
        """Whether a bar is shown, above which `LightningModule.print` prints by `print`."""
        return self._enabled

    def disable(self) -> None:
        self._enabled = False

    def enable(self) -> None:
        self._enabled = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self._first_step = trainer.global_step
        self._doing = "training"
        self._bar = self._open(self._doing, SCALE, keep=True)

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,  # noqa: ARG002
        outputs: Any,  # noqa: ARG002
        batch: Any,  # noqa: ARG002
        batch_idx: int,  # noqa: ARG002
    ) -> None:
        if self._enabled and trainer.global_step % max(1, trainer.log_every_n_steps) == 0:  # type: ignore[attr-defined]  # (Lightning sets it)
            loss = trainer.callback_metrics.get("train/loss")
            self._loss = "" if loss is None else f"loss {float(loss):.3g}"
        self._show_step(trainer)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self._show_step(trainer)
        self._close()

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        if trainer.sanity_checking:
            return
        if trainer.state.fn == TrainerFn.FITTING:
            self._doing = "validating"
            self._show_step(trainer)
            if self._bar is not None:
                self._bar.refresh()
        else:
            self._bar = self._open("validating", sum(trainer.num_val_batches))

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        if trainer.sanity_checking:
            return
        error = trainer.callback_metrics.get("valid/mse")
        self._valid = "" if error is None else f"validation error {with_unit(float(error))}"
        if trainer.state.fn != TrainerFn.FITTING:
            self._close()
        else:
            self._doing = "training"
            self._show_step(trainer)

    def on_validation_batch_end(self, trainer: Trainer, *_: Any) -> None:
        if trainer.state.fn != TrainerFn.FITTING:
            self._count_batch()

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self._bar = self._open("testing", sum(trainer.num_test_batches))

    def on_test_batch_end(self, *_: Any) -> None:
        self._count_batch()

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self._close()

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self._bar = self._open("predicting", sum(trainer.num_predict_batches))

    def on_predict_batch_end(self, *_: Any) -> None:
        self._count_batch()

    def on_predict_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self._close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:  # noqa: ARG002
        self._close()

    def print(self, *words: Any, **options: Any) -> None:
        """Print a line above the bar."""
        if self._bar is None:
            super().print(*words, **options)
        else:
            Tqdm.write(" ".join(map(str, words)), file=sys.stdout)

    def text(self, trainer: Trainer, left: TimeLeft) -> str:
        """What is shown beside the bar."""
        total = total_steps(trainer)
        of = f"/{int(total)}" if math.isfinite(total) else ""
        eta = "" if left.seconds is None else f"{timedelta(seconds=round(left.seconds))} left"
        if eta and left.ends_by:
            eta += f" to {left.ends_by}"
        parts = (f"{self._doing}: step {trainer.global_step}{of}", eta, self._loss, self._valid)
        return ", ".join(part for part in parts if part)

    def _show_step(self, trainer: Trainer) -> None:
        bar = self._bar
        if bar is None or bar.disable:
            return
        left = time_left(trainer, self._first_step, bar.format_dict["elapsed"])
        bar.set_description_str(self.text(trainer, left), refresh=False)
        bar.update(max(0, min(SCALE, round(SCALE * left.share)) - bar.n))
        bar.update(0)

    def _open(self, what: str, total: float, keep: bool = False) -> Tqdm:
        form = "{percentage:3.0f}% |{bar:20}| {desc}" if keep else "{desc} {n_fmt}/{total_fmt}, {remaining} left"
        terminal = sys.stdout.isatty()
        pause = 0.2 if terminal else LOG_FILE_SECONDS
        columns, rows = _missing_size()
        return Tqdm(
            desc=what,
            total=total,
            leave=keep or not terminal,  # a file keeps what is written: what follows starts a line of its own
            bar_format=form,
            file=sys.stdout,
            disable=not self._enabled,
            mininterval=pause,
            maxinterval=pause,
            miniters=0,
            ncols=columns,
            nrows=rows,
            dynamic_ncols=columns is None,
        )

    def _count_batch(self) -> None:
        if self._bar is not None:
            self._bar.update()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _missing_size() -> tuple[int, int] | tuple[None, None]:
    """A size for terminals that state none, as in some containers, where tqdm would write nothing; else None."""
    try:
        stated = os.get_terminal_size(sys.stdout.fileno()).columns > 0
    except (OSError, ValueError):
        stated = True  # no terminal
    return (None, None) if stated else (80, 24)
