"""Says early what will come of a training's time, and bounds what its validations take of it."""

from __future__ import annotations

import math
import statistics
import time
from datetime import timedelta
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.recordings import EvaluationLoader
from nmpm.particles import Window
from nmpm.training.budget import (
    lengthen_validation_interval,
    reserve_time,
    seconds_left,
    total_steps,
    validation_interval,
)
from nmpm.training.module import EmulatorModule

SKIPPED, MEASURED = 4, 16
"""Steps that are left out of the pace, as kernels compile in them, and steps that it is measured by."""

PASSES = 3
"""Time of a training step in rollouts of its batch as long as the horizon: gradients take twice that of a rollout."""

VALIDATION_SHARE = 0.2
"""Share of a training's time that its validations take together, at most; but each has one batch."""


class Forecast(Callback):
    """Measures the pace of a training over some steps. Then, once:

    - if all validations together would take more than `VALIDATION_SHARE` of the time, they get fewer trajectories;
      after one of the start they keep these, and are further apart if their interval is stated as a time;
    - the steps end early enough for the last validation to be within `max_time`;
    - if `max_time` ends the training before half of its steps, a line says so, what that costs and what to do.

    Before the test that follows, it says how long that takes.
    """

    def __init__(self) -> None:
        self._seconds: list[float] = []  # of the steps measured
        self._step, self._since = -1, math.nan
        self._validation_start = self._batch_start = math.nan
        # Seconds of a frame of one trajectory in an evaluation by one process: estimated, and of each batch measured.
        self._estimate: float | None = None
        self._measured: list[float] = []

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._seconds, self._step, self._since = [], trainer.global_step, math.nan

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        if len(self._seconds) == SKIPPED + MEASURED or trainer.global_step == self._step:
            return
        self._step, former, self._since = trainer.global_step, self._since, time.monotonic()
        if math.isnan(former):
            return  # the first step, or the one after a validation
        self._seconds.append(self._since - former)
        if len(self._seconds) == SKIPPED + MEASURED:
            pace = statistics.median(self._seconds[SKIPPED:])
            self._decide(trainer, pl_module, trainer.strategy.broadcast(pace))

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._since, self._validation_start = math.nan, time.monotonic()
        data = trainer.datamodule  # type: ignore[attr-defined]  # (Lightning sets it)
        if isinstance(data, TrajectoryDataModule) and data.validated is None and not trainer.sanity_checking:
            data.validated = len(data.recordings("valid"))  # a resumed training keeps to it

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._step == 0 and trainer.global_step == 0 and not math.isnan(self._validation_start):
            lengthen_validation_interval(trainer, (time.monotonic() - self._validation_start) / VALIDATION_SHARE)

    def on_validation_batch_start(self, *_: Any) -> None:
        self._batch_start = time.monotonic()

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Window, *_: Any
    ) -> None:
        scenes, frames = batch.target.shape[:2]
        if scenes:
            self._measured.append((time.monotonic() - self._batch_start) / (scenes * frames))

    @property
    def _frame_seconds(self) -> float | None:
        later = self._measured[1:]  # kernels compile in the first
        return statistics.fmean(later) if later else self._estimate

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        loader = trainer.test_dataloaders
        if self._step < 0 or not isinstance(loader, EvaluationLoader) or not isinstance(pl_module, EmulatorModule):
            return  # no training came before, or another kind
        batches = loader.batches[: int(trainer.num_test_batches[0])]
        frames = sum(loader.recordings.predicted_frames(index) for batch in batches for index in batch)
        takes = f" takes about {_clock(frames * self._frame_seconds)}" if self._frame_seconds else ""
        slow = [type(metric).__name__ for metric in pl_module.test_errors.of_model if not metric.cheap]
        more = f", and the time of {', '.join(slow)}" if slow else ""
        pl_module.print(f"The closing test{takes or ' follows'}{more} (--trainer.limit_test_batches N shortens it).")

    def _decide(self, trainer: Trainer, module: LightningModule, pace: float) -> None:
        """Bound the validations of a training with a pace in seconds per step, and say what fits into its time."""
        data = trainer.datamodule  # type: ignore[attr-defined]  # (Lightning sets it)
        if not isinstance(module, EmulatorModule) or not isinstance(data, TrajectoryDataModule):
            return
        windows = data.batch_size * trainer.accumulate_grad_batches
        self._estimate = pace / (PASSES * windows * module.emulator.frames * module.unroll)
        interval, total = validation_interval(trainer, pace), total_steps(trainer)
        validation = self._bound_validations(trainer, data, module, pace, interval)
        available = seconds_left(trainer)
        reserve_time(trainer, validation)
        reached = trainer.global_step + max(available - validation, 0) / (pace + validation / interval)
        if reached < total / 2 and math.isfinite(total):
            needed = (total - trainer.global_step) * (pace + validation / interval) + validation
            elapsed = trainer.global_step * pace
            module.print(
                f"At {pace:.2g} s a step, max_time ends this training after about {int(reached)} of {int(total)} steps,"
                " validations included. The learning rate comes down in time for that, but fewer steps mean a larger"
                f" error. For all of them: --trainer.max_time {_as_option(needed + elapsed)}; for faster steps: end"
                " other programs, use a GPU, or a smaller model (--model.processor, --model.cells, --model.unroll)."
            )

    def _bound_validations(
        self, trainer: Trainer, data: TrajectoryDataModule, module: EmulatorModule, pace: float, interval: float
    ) -> float:
        """Seconds of one validation, after its trajectories have been made few enough."""
        if not trainer.enable_validation:
            return 0.0
        recordings = data.recordings("valid")
        limit = data.limit_eval or data.validated
        frames = list(map(recordings.predicted_frames, recordings.indices))[:limit]
        seconds = (self._frame_seconds or 0.0) * sum(frames) / trainer.world_size
        left = min(seconds_left(trainer), (total_steps(trainer) - trainer.global_step) * pace)
        count = math.ceil(left / pace / interval) or 1
        share = seconds * count / (trainer.global_step * pace + left)
        by_user = data.limit_eval or trainer.limit_val_batches != 1.0
        few = max(int(len(frames) * VALIDATION_SHARE / share), data.eval_batch_size) if share else len(frames)
        loader = trainer.val_dataloaders
        if by_user or data.validated or few >= len(frames) or not isinstance(loader, EvaluationLoader):
            return seconds
        data.validated = few
        loader.restrict(few)
        module.print(
            f"Validations on all {len(frames)} trajectories, {_clock(seconds)} each, would take"
            f" {share:.0%} of the training's time: they use the first {few} (--data.limit_eval sets another number)."
        )
        return seconds * sum(frames[:few]) / sum(frames)


def _clock(seconds: float) -> timedelta:
    return timedelta(seconds=max(round(seconds), 1))


def _as_option(seconds: float) -> str:
    """A time as `--trainer.max_time` takes it, in whole minutes above."""
    minutes = math.ceil(seconds / 60)
    return f"{minutes // 1440:02d}:{minutes // 60 % 24:02d}:{minutes % 60:02d}:00"
