"""Optimizers made from a configuration, and checks of their learning rates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial

import torch
from torch import Tensor
from torch.optim import Optimizer

from nmpm.errors import ConfigError, NmpmError

OptimizerCallable = Callable[[Iterable], Optimizer]  # type: ignore[type-arg]  # (jsonargparse knows this form)


def adam(parameters: Iterable[Tensor]) -> Optimizer:
    """The paper's optimizer."""
    return torch.optim.Adam(parameters, lr=1e-3)


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
    """Make sure that a learning rate, where it is a plain number, is positive and finite.

    Raises:
        ConfigError: if it is not.
    """
    if isinstance(rate, int | float) and not 0 < rate < math.inf:
        raise ConfigError(f"model.optimizer.lr = {rate} must be a positive number.")


def build_optimizer(make: OptimizerCallable, parameters: Iterable[Tensor]) -> Optimizer:
    """The optimizer of some parameters.

    Raises:
        ConfigError: if an argument is not allowed, such as a negative learning rate.
    """
    try:
        optimizer = make(parameters)
    except NmpmError:
        raise
    except ValueError as error:
        raise ConfigError(f"model.optimizer does not take its arguments: {error}.") from error
    for group in optimizer.param_groups:
        check_learning_rate(group.get("lr"))
    return optimizer
