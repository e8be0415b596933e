"""Checkpoints of a run: the best weights, and the last ones, to go on from after Ctrl-C, SIGTERM or a kill."""

from __future__ import annotations

import math
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Any

from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_info, rank_zero_warn
from torch import Tensor

from nmpm.errors import DataError
from nmpm.training.checkpoints import read_checkpoint
from nmpm.training.preflight import OVERALL

RANKS_AGREE_EVERY = 16
"""Steps between exchanges of several ranks, which read back from the device."""


class BestCheckpoint(ModelCheckpoint):
    """A ModelCheckpoint that takes the best scores so far from the files in its folder.

    Lightning's checkpoints name files by absolute paths, and may be older than the best weights: a run that was moved,
    or killed after a validation, would lose its best weights to worse ones. A validation that was due at the step that
    a training goes on from, and has no score, is run first.

    Attributes:
        scored_step: Step of the last weights that have a score; -1 before the first, or where no best weights are left.
        scores_start: Whether a new training validates the weights that it starts with, so that its best weights are
            never worse than those.
        start_score: The score of these weights; None where they were not validated.
    """

    scored_step = -1
    scores_start = False
    start_score: float | None = None

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"scored_step": self.scored_step, "start_score": self.start_score}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.scored_step = int(state_dict["scored_step"]) if self.best_k_models else -1
        self.start_score = state_dict.get("start_score")

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        if trainer.state.fn != TrainerFn.FITTING or not self.save_top_k or self.monitor is None:
            return
        step = int(checkpoint["global_step"])
        self._take(trainer.strategy.broadcast(self._stored_scores() if trainer.is_global_zero else {}))
        state = checkpoint["callbacks"].get(self.state_key, {})
        if self.best_model_score is not None:
            file, score = Path(self.best_model_path).name, float(self.best_model_score)
            rank_zero_info(f"Going on from step {step}; best so far: {self.monitor} = {score:.4g} ({file}).")
        elif state.get("best_model_path"):
            rank_zero_warn(
                f"Going on from step {step} without the best weights so far: {Path(state['best_model_path']).name} is"
                f" not in {self.dirpath}. The best are those of the validations from here on."
            )

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_start(trainer, pl_module)
        loop = trainer.fit_loop.epoch_loop
        if trainer.global_step == 0:
            due = self.scores_start and trainer.enable_validation
            self._last_global_step_saved = -1  # Lightning's 0 means that step 0 is saved already
        else:
            due = loop._should_check_val_fx(trainer.fit_loop._data_fetcher)  # type: ignore[arg-type]  # (set by now)
        if due and self.scored_step < trainer.global_step:
            first, trainer.validating = trainer._logger_connector._first_loop_iter, True
            loop.val_loop.restarting = False
            loop.val_loop.run()
            trainer.training, trainer._logger_connector._first_loop_iter = True, first

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.state.fn == TrainerFn.FITTING and not trainer.sanity_checking:
            self.scored_step = trainer.global_step
            if trainer.global_step == 0 and self.monitor:
                self.start_score = float(trainer.callback_metrics[self.monitor])
        super().on_validation_end(trainer, pl_module)

    def score(self, trainer: Trainer) -> None:
        """Take the scores of a validation after the training, and save the weights if they are among the best."""
        self.scored_step = trainer.global_step
        self._save_topk_checkpoint(trainer, self._monitor_candidates(trainer))

    def describe_progress(self, best_step: int, steps: int) -> str:
        """One line: the score of the weights that a training of so many steps started with, and of the best ones."""
        start, best = self.start_score or math.nan, float(self.best_model_score or math.nan)
        if best_step == 0:
            return (
                f"None of the validations in {steps} steps was better than that of the start, {self.monitor} ="
                f" {start:.3g}: the best weights are those that the training started with."
            )
        return f"{self.monitor} = {start:.3g} at the start, {best:.3g} after {best_step} of {steps} steps, the best."

    def _stored_scores(self) -> dict[str, Tensor]:
        """Paths of the best checkpoints in the folder, and the scores that they state of themselves."""
        scores: dict[str, Tensor] = {}
        for path in sorted(Path(str(self.dirpath)).glob(f"[!.]*{self.FILE_EXTENSION}")):
            try:
                state = read_checkpoint(path).get("callbacks", {}).get(self.state_key, {})
            except DataError as error:
                rank_zero_warn(f"Not one of the best weights: {error}")
                continue
            # Of other checkpoints, such as last.ckpt, it names the best ones of their time, but not themselves.
            scores |= {str(path): score for name, score in state.get("best_k_models", {}).items()
                       if Path(name).name == path.name}  # fmt: skip
        return scores

    def _take(self, scores: dict[str, Tensor]) -> None:
        ranked = sorted(scores, key=lambda path: float(scores[path]), reverse=self.mode == "max")
        kept = ranked[: self.save_top_k] if self.save_top_k > 0 else ranked
        self.best_k_models = {path: scores[path] for path in kept}
        if kept:
            self.best_model_path, self.kth_best_model_path = kept[0], kept[-1]
            self.best_model_score, self.kth_value = scores[kept[0]], scores[kept[-1]]


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

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._running:
            self._stop_if_requested(trainer)
            self._save(trainer)
            self._validating = True

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
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
        if trainer.strategy.reduce_boolean_decision(self._requested, all=False):
            self._save(trainer)
            raise KeyboardInterrupt

    def _save(self, trainer: Trainer) -> None:
        if not trainer.fit_loop._should_accumulate():
            self._save_checkpoint(trainer, self.format_checkpoint_name(self._monitor_candidates(trainer)))

    def _handle(self, signum: int, frame: FrameType | None) -> None:
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


# Two savers, as ModelCheckpoint's `save_last` leaves the last checkpoint as it was whenever the best does not change.
DEFAULTS: dict[str, tuple[type[ModelCheckpoint], dict[str, Any]]] = {
    "best": (BestCheckpoint, {"monitor": f"valid/{OVERALL}"}),
    "last": (LastCheckpoint, {"every_n_train_steps": 100}),
}
