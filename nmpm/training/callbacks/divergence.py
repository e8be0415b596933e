"""Stop a training whose loss or weights are not finite, before they are in a checkpoint; warn of a risen loss."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor

from nmpm.errors import NmpmError

RECENT = 10
"""Logged losses whose median is compared with the least such median before."""
MOST_RISE = 10.0
"""Ratio from which the loss has risen: below 2.5 in 12 trainings of the zoo, 50 in one that diverged."""


class DivergedError(NmpmError):
    """The loss or the weights of a training are not finite."""

    exit_status = 3


class DivergenceGuard(Callback):
    """Checks the loss every `log_every_n_steps` steps, and the weights before each checkpoint and at the end.

    It warns once if the loss, finite still, has risen to `MOST_RISE` times its least.

    Raises:
        DivergedError: naming what is not finite, and the last good checkpoint.
    """

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=RECENT)
        self._least, self._warned = math.inf, False

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *_: Any) -> None:
        if trainer.global_step % max(1, trainer.log_every_n_steps):  # type: ignore[attr-defined]  # (Lightning sets it)
            return
        loss = outputs["loss"] if isinstance(outputs, dict) else outputs
        value = float(loss) if isinstance(loss, Tensor) else None
        broken = value is not None and not math.isfinite(value)
        # All ranks stop together: one that raised alone would leave the others waiting in their next collective.
        if trainer.strategy.reduce_boolean_decision(broken, all=False):
            raise self._diverged_error(
                trainer, f"the loss is {value}" if broken else "the loss of another rank is not finite"
            )
        if value is not None:
            self._warn_of_rise(trainer, value)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        self._check_weights(trainer, checkpoint["state_dict"].items())

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._check_weights(trainer, pl_module.named_parameters())

    def _warn_of_rise(self, trainer: Trainer, loss: float) -> None:
        """Warn, once, where the median of the recent losses is far above its least."""
        self._recent.append(loss)
        if len(self._recent) < RECENT or self._warned:
            return
        typical = statistics.median_low(self._recent)
        self._least = min(self._least, typical)
        if typical > MOST_RISE * self._least:
            self._warned = True
            best = [saver.best_model_path for saver in _savers(trainer) if saver.monitor is not None]
            start = next((f" --start_from {path}" for path in best if path), "")
            rank_zero_warn(
                f"At step {trainer.global_step} the loss is {typical / self._least:.0f} times its least (medians of"
                f" {RECENT} logged steps): the training seems to have diverged. Stop it, and start again{start} with a"
                " lower model.optimizer.init_args.lr, or with fewer frames to backpropagate through (model.frames"
                " times model.unroll): gradients through many frames of a turbulent flow explode. Keep"
                " model.gradient_discount at 0.5: at 1 they are larger, at 0 trainings diverge."
            )

    def _check_weights(self, trainer: Trainer, weights: Iterable[tuple[str, Tensor]]) -> None:
        """Called on all ranks; a rank that holds no weights, as under sharding, has nothing to report."""
        broken = next((name for name, values in weights if not torch.isfinite(values).all()), None)
        if trainer.strategy.reduce_boolean_decision(broken is not None, all=False):
            raise self._diverged_error(trainer, f"the weights {broken or 'of another rank'} are not finite")

    def _diverged_error(self, trainer: Trainer, what: str) -> DivergedError:
        # One that is saved regardless of the validation error may be from after the loss began to rise.
        good = [saver for saver in _savers(trainer) if saver.monitor is not None or not self._warned]
        paths = [Path(str(saver.dirpath)) / f"{saver.filename}{saver.FILE_EXTENSION}" for saver in good]
        kept = [str(path) for path in paths if path.is_file()]
        return DivergedError(
            f"The training has diverged: at step {trainer.global_step} {what}. Lower the learning rate"
            " (--model.optimizer.init_args.lr; with --ckpt_path best it goes on from the best weights), clip gradients"
            f" harder, or unroll fewer bundles. Good checkpoints: {', '.join(kept) or 'none was written yet'}."
        )


def _savers(trainer: Trainer) -> list[ModelCheckpoint]:
    return [saver for saver in trainer.checkpoint_callbacks if isinstance(saver, ModelCheckpoint)]
