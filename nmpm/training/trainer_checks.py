"""Reject, before the first step, options of a Lightning Trainer that an emulator cannot be trained with.

Lightning itself rejects further ones when the Trainer is made. `docs/lightning.md` lists what works.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import (
    BackboneFinetuning,
    BatchSizeFinder,
    GradientAccumulationScheduler,
    LearningRateFinder,
    ModelPruning,
    SpikeDetection,
    StochasticWeightAveraging,
    WeightAveraging,
)
from lightning.pytorch.strategies import ModelParallelStrategy

from nmpm.errors import ConfigError

OURS = ("nmpm.", "lightning.")
"""Packages whose modules and callbacks log nothing but `LOGGED`."""
LOGGED = ("train/loss", "valid/")
"""How names of logged values begin."""
COUNT_EPOCHS = "needs epochs that end, and batches are endless: give limit_train_batches=N and max_epochs"


def check_trainer(trainer: Trainer, module: LightningModule) -> None:
    """Make sure that a module can be trained by a trainer.

    Raises:
        ConfigError: naming the option, and what to do instead.
    """
    for reason in (*_trainer_reasons(trainer, module), *_callback_reasons(trainer, module)):
        raise ConfigError(reason)
    check_precision(trainer)


def check_precision(trainer: Trainer) -> None:
    """Make sure that a trainer leaves positions in float32 or better.

    Raises:
        ConfigError: if it computes in half precision throughout.
    """
    converted = trainer.precision_plugin.convert_input(torch.zeros(1, dtype=torch.float32)).dtype
    if torch.finfo(converted).bits < 32:
        name = str(converted).removeprefix("torch.")
        raise ConfigError(
            f"precision={trainer.precision}: positions in {name} would be off by whole cells. Give"
            ' precision="bf16-mixed", in which only the network computes in bfloat16, or "32-true".'
        )


def check_evaluating_trainer(trainer: Trainer) -> None:
    """Make sure that a module can be evaluated by a trainer.

    Raises:
        ConfigError: naming the option, and what to do instead.
    """
    check_precision(trainer)
    if any(isinstance(one, BatchSizeFinder) for one in _callbacks(trainer)):
        raise ConfigError(
            "BatchSizeFinder changes data.batch_size, which is that of trainings: evaluate by another Trainer."
        )


def check_new(steps: int) -> None:
    """Make sure that a trainer is not used for a second training, which would end at once or go on from its steps.

    Args:
        steps: That it has taken in others.

    Raises:
        ConfigError: if there are any.
    """
    if steps:
        raise ConfigError(
            f"This Trainer has taken {steps} steps already, and counts on from there: make a new Trainer for another"
            " training, or give ckpt_path to go on with this one."
        )


def check_resuming_trainer(trainer: Trainer) -> None:
    """Make sure that a trainer's callbacks can go on from a checkpoint.

    Raises:
        ConfigError: naming the callback, and what to do instead.
    """
    for one in _callbacks(trainer):
        if isinstance(one, LearningRateFinder | BatchSizeFinder | SpikeDetection):
            raise ConfigError(
                f"{type(one).__name__} cannot go on from a checkpoint: leave it out, and give what it has found."
            )


def _trainer_reasons(trainer: Trainer, module: LightningModule) -> Iterator[str]:
    if module._compiler_ctx is not None:
        yield (
            "torch.compile of an EmulatorModule is not supported: give it compile=True, by which the network is"
            " compiled."
        )
    if trainer.accumulate_grad_batches < 1:
        yield f"accumulate_grad_batches={trainer.accumulate_grad_batches} must be at least 1."
    if isinstance(trainer.strategy, ModelParallelStrategy):
        yield 'ModelParallelStrategy splits networks that are too large for one device: give strategy="ddp".'
    if trainer.fit_loop.min_epochs and not _counts_epochs(trainer):
        option = "min_epochs" if trainer.fit_loop.min_steps is None else "min_steps"  # (which sets min_epochs to 1)
        yield f"{option}={getattr(trainer.fit_loop, option)} {COUNT_EPOCHS}, or leave it out."


def _callback_reasons(trainer: Trainer, module: LightningModule) -> Iterator[str]:
    endless = not _counts_epochs(trainer)
    for one in _callbacks(trainer):
        name = type(one).__name__
        if isinstance(one, BackboneFinetuning) and not hasattr(module, "backbone"):
            yield f"{name} needs a module with a backbone: train a pretrained emulator by EmulatorModule.of instead."
        if isinstance(one, ModelPruning):
            yield f"{name}: masks on weights are not supported; choose a network with fewer channels."
        if isinstance(one, StochasticWeightAveraging) and endless:
            yield f"{name} {COUNT_EPOCHS}, or take EMAWeightAveraging(use_buffers=False)."
        if isinstance(one, GradientAccumulationScheduler) and endless and max(one.scheduling) > 0:
            yield f"{name} from epoch {max(one.scheduling)} on {COUNT_EPOCHS}, or accumulate_grad_batches."
        if (
            isinstance(one, WeightAveraging)
            and one._use_buffers
            and not (one._kwargs.get("avg_fn") or one._kwargs.get("multi_avg_fn"))
        ):
            yield f"{name}: give use_buffers=False; normalisation statistics are constants, which have no average."

    for one, monitor in [] if may_log_more(trainer, module) else _monitors(trainer):
        if not monitor.startswith(LOGGED):
            yield f"{type(one).__name__} monitors {monitor}, which is not logged: give valid/overall, for example."


def may_log_more(trainer: Trainer, module: LightningModule) -> bool:
    """Whether a module or callback of the user's may log what callbacks monitor."""
    return any(not type(one).__module__.startswith(OURS) for one in (module, *_callbacks(trainer)))


def _monitors(trainer: Trainer) -> Iterator[tuple[object, str]]:
    """Callbacks that need a logged value by the end of validations, and its name."""
    for one in _callbacks(trainer):
        monitor = getattr(one, "monitor", None)
        late = getattr(one, "_check_on_train_epoch_end", False) or getattr(one, "_save_on_train_epoch_end", False)
        if isinstance(monitor, str) and not late and getattr(one, "strict", True):
            yield one, monitor


def _counts_epochs(trainer: Trainer) -> bool:
    return isinstance(trainer.limit_train_batches, int)


def _callbacks(trainer: Trainer) -> list[object]:
    return list(trainer.callbacks)  # type: ignore[attr-defined]  # (Lightning sets it)
