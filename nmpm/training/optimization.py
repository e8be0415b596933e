"""Optimizers made from a configuration, and the schedule of their learning rate over a training."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.optim import Optimizer

from nmpm.errors import ConfigError, NmpmError

OptimizerCallable = Callable[[Iterable], Optimizer]  # type: ignore[type-arg]  # (jsonargparse knows this form)


def adam(parameters: Iterable[Tensor]) -> Optimizer:
    """The paper's optimizer."""
    return torch.optim.Adam(parameters, lr=1e-3)


def build_optimizer(make: OptimizerCallable, parameters: Iterable[Tensor]) -> Optimizer:
    """The optimizer of some parameters; ConfigError for an argument such as a negative learning rate."""
    try:
        optimizer = make(parameters)
    except NmpmError:
        raise
    except ValueError as error:
        raise ConfigError(f"model.optimizer does not take its arguments: {error}.") from error
    closure = inspect.signature(optimizer.step).parameters.get("closure")
    if closure is not None and closure.default is closure.empty:
        raise ConfigError(
            f"model.optimizer: {type(optimizer).__name__} searches along lines, and each training step draws other"
            " windows: take nmpm.optimizers.SOAP, torch.optim.Adam or another optimizer of single gradients."
        )
    for group in optimizer.param_groups:
        check_learning_rate(group.get("lr"))
    return optimizer


def with_learning_rate(make: OptimizerCallable, rate: float) -> OptimizerCallable:
    """The optimizers that a function makes, with another learning rate."""
    check_learning_rate(rate)
    return partial(_build_at_rate, make, rate)


def _build_at_rate(make: OptimizerCallable, rate: float, parameters: Iterable[Tensor]) -> Optimizer:
    optimizer = make(parameters)
    for group in optimizer.param_groups:
        group["lr"] = rate
    return optimizer


def check_learning_rate(rate: object) -> None:
    """Raise ConfigError if a learning rate is a plain number, but not positive and finite."""
    if isinstance(rate, int | float) and not 0 < rate < math.inf:
        raise ConfigError(f"model.optimizer.lr = {rate} must be a positive number.")


@dataclass(frozen=True)
class Schedule:
    """Factor on the learning rate over the training: linear warm-up, a flat stretch, half a cosine to zero.

    The form of arXiv 2408.15753, appendix: 1e-5 → 1e-3 over 100 steps, 900 flat, cosine over 100,000.

    Args:
        warmup: Steps of the linear part.
        flat: Steps at the full rate after it.
        start: Factor at step 0.
    """

    warmup: int = 100
    flat: int = 0
    start: float = 0.01

    def factor(self, step: int, total: float, clock: float = 0.0) -> float:
        """The factor at a step; 0 once the steps or the time are over, whichever is first.

        Args:
            step: Steps taken.
            total: Steps of the whole training; infinite where only its time is limited.
            clock: Share of the training's time that is over, in [0, 1]; 0 where only its steps are limited.
        """
        begin = self.warmup + self.flat
        by_time = (clock * total - begin) / max(total - begin, 1) if math.isfinite(total) else clock
        by_steps = (step - begin) / max(total - begin, 1)
        decay = 0.5 * (1 + math.cos(math.pi * min(max(by_steps, by_time, 0.0), 1.0)))
        warm = self.start + (1 - self.start) * step / self.warmup if step < self.warmup else 1.0
        return min(warm, decay)
