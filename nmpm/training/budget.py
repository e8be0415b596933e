"""What ends a training: its steps, its epochs or its time."""

from __future__ import annotations

import math

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.callbacks.timer import Interval

from nmpm.errors import ConfigError

CLOCK_EVERY = 16
"""Steps between readings of rank 0's clock: other ranks read it back from the device."""

ENDLESS = (
    "The training has no end, as its batches are endless: give --trainer.max_steps N or --trainer.max_time DD:HH:MM:SS"
    " (or, to count epochs, --trainer.limit_train_batches N)."
)


def total_steps(trainer: Trainer) -> float:
    """Optimizer steps of the whole training; infinite where nothing but its time is limited. Loads its data."""
    steps = trainer.estimated_stepping_batches  # -1 where epochs are limited and their batches are endless
    return math.inf if steps == -1 else steps


class Clock:
    """Share of a trainer's time that is over, the same on all ranks."""

    def __init__(self) -> None:
        self._share = 0.0

    def share(self, trainer: Trainer, step: int) -> float:
        """The share at a step, in [0, 1]; 0 where the time is not limited.

        All ranks get rank 0's: by clocks of their own, their learning rates and weights would drift apart. Several
        ranks exchange it every `CLOCK_EVERY` steps only.
        """
        timers = _timers(trainer)
        if timers and (trainer.world_size == 1 or step % CLOCK_EVERY == 0):
            elapsed = max(timer.time_elapsed() / (timer._duration or 1.0) for timer in timers)
            self._share = trainer.strategy.broadcast(min(elapsed, 1.0))
        return self._share


def check_end(trainer: Trainer) -> None:
    """Raise ConfigError if neither the steps nor the time of a training are limited. Loads its data."""
    if math.isinf(total_steps(trainer)) and not _stops_by_time(trainer):
        raise ConfigError(ENDLESS)


def check_endless_batches(trainer: Trainer) -> None:
    """Raise ConfigError, before any data are loaded, if a training on endless batches takes no step or has no end."""
    limit = trainer.limit_train_batches
    for name, value in (
        *(("max_steps", trainer.max_steps), ("max_epochs", trainer.max_epochs), ("limit_train_batches", limit)),
        *(("max_time", timer._duration) for timer in _timers(trainer)),
    ):
        if value == 0:
            raise ConfigError(f"--trainer.{name} {value:g}: nothing would be trained; give more, or run `nmpm test`.")
    if isinstance(limit, float) and limit != 1.0:
        raise ConfigError(
            f"--trainer.limit_train_batches {limit} is a share of batches that are endless; give a whole number."
        )
    counted = isinstance(limit, int) and (trainer.max_epochs or -1) > 0
    if trainer.max_steps == -1 and not counted and not _stops_by_time(trainer):
        raise ConfigError(ENDLESS)


def seconds_left(trainer: Trainer) -> float:
    """Seconds until time ends a training; infinite where its time is not limited."""
    left = [(timer._duration or 0.0) - timer.time_elapsed() for timer in _timers(trainer)]
    return max(min(left, default=math.inf), 0.0)


def reserve_time(trainer: Trainer, seconds: float) -> None:
    """End a training so many seconds earlier, at most half of what is left, for what follows its last step."""
    for timer in _timers(trainer):
        duration = timer._duration or 0.0
        timer._duration = duration - min(seconds, max(duration - timer.time_elapsed(), 0.0) / 2)


def validation_interval(trainer: Trainer, pace: float) -> float:
    """Steps between validations at a pace in seconds per step; infinite where only the end is validated, or nothing."""
    if not trainer.enable_validation:
        return math.inf
    seconds = trainer._val_check_time_interval  # type: ignore[attr-defined]  # (Lightning sets it)
    if seconds is not None:
        return float(seconds / pace)
    epochs, batches = trainer.check_val_every_n_epoch or 1, trainer.val_check_batch or math.inf
    return float(max(epochs * batches / trainer.accumulate_grad_batches, 1.0))


def lengthen_validation_interval(trainer: Trainer, seconds: float) -> None:
    """Let at least so many seconds lie between validations, where their interval is stated as a time."""
    interval = trainer._val_check_time_interval  # type: ignore[attr-defined]  # (Lightning sets it)
    if interval is not None:
        trainer._val_check_time_interval = max(interval, seconds)  # type: ignore[attr-defined]


def _timers(trainer: Trainer) -> list[Timer]:
    """The timers that limit a training: the trainer's `max_time`, and others among its callbacks."""
    callbacks = trainer.callbacks  # type: ignore[attr-defined]  # (Lightning sets it)
    return [callback for callback in callbacks if isinstance(callback, Timer) and callback._duration is not None]


def _stops_by_time(trainer: Trainer) -> bool:
    """Whether a timer stops the training between steps; one that waits for the epoch's end may wait for ever."""
    return any(timer._interval == Interval.step for timer in _timers(trainer))
