"""Checks before the first step: options of the Trainer, precision, metrics, monitored errors, memory and disk space.

Lightning itself rejects further options when the Trainer is made. `docs/lightning.md` lists what works.
"""

from __future__ import annotations

import copy
import errno
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import (
    BackboneFinetuning,
    BatchSizeFinder,
    GradientAccumulationScheduler,
    LearningRateFinder,
    ModelCheckpoint,
    ModelPruning,
    SpikeDetection,
    StochasticWeightAveraging,
    WeightAveraging,
)
from lightning.pytorch.strategies import ModelParallelStrategy
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor
from torchmetrics import Metric

from nmpm._support.machine import computes_bfloat16, free_memory
from nmpm._support.messages import one_line, suggestion
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.grid_rule import MULTIPLE, TrainingSize, grid_shape
from nmpm.data.recordings import SplitRecordings
from nmpm.data.windows import collate
from nmpm.emulator import Emulator
from nmpm.errors import ConfigError, NmpmError
from nmpm.evaluation.comparison import Comparison, still
from nmpm.processors import GridProcessor, UNet

_LOG = logging.getLogger(__name__)
OVERALL = "overall"
"""Name of the validation error by which the best checkpoint is chosen, see `overall_error`."""
FLOAT32, BFLOAT16 = "32-true", ("bf16", "bf16-mixed")
"""Lightning's names of precisions."""
PACKAGES = ("nmpm.", "lightning.")
"""Packages whose modules and callbacks log nothing but the training's loss and the errors of evaluations."""
CHECKPOINT_SIZE = 5
"""Bytes of a checkpoint for each of the weights', at most: averaged ones and the state of SOAP or Adam with them."""
REPORT_BYTES = 32 * 2**20
"""Of the report with its pictures, and of logs."""
MEMORY_MARGIN = 1.25
"""Times the free memory that a training's estimate may reach: estimates are within a quarter."""

_ELSEWHERE = "Free some, or write elsewhere with --trainer.default_root_dir."
_COUNT_EPOCHS = "needs epochs that end, and batches are endless: give limit_train_batches=N and max_epochs"


# Options of the Trainer


def check_trainer(trainer: Trainer, module: LightningModule) -> None:
    """Raise ConfigError, naming the option and what to do instead, if a module cannot be trained by a trainer."""
    for reason in (*_trainer_reasons(trainer, module), *_callback_reasons(trainer, module)):
        raise ConfigError(reason)
    _check_precision(trainer)


def check_evaluating_trainer(trainer: Trainer) -> None:
    """Raise ConfigError if a module cannot be evaluated by a trainer."""
    _check_precision(trainer)
    if any(isinstance(callback, BatchSizeFinder) for callback in _callbacks(trainer)):
        raise ConfigError(
            "BatchSizeFinder changes data.batch_size, which is that of trainings: evaluate by another Trainer."
        )


def check_resuming_trainer(trainer: Trainer) -> None:
    """Raise ConfigError if a callback of a trainer cannot go on from a checkpoint."""
    for callback in _callbacks(trainer):
        if isinstance(callback, LearningRateFinder | BatchSizeFinder | SpikeDetection):
            raise ConfigError(
                f"{type(callback).__name__} cannot go on from a checkpoint: leave it out, and give what it has found."
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
        yield f"{option}={getattr(trainer.fit_loop, option)} {_COUNT_EPOCHS}, or leave it out."


def _callback_reasons(trainer: Trainer, module: LightningModule) -> Iterator[str]:
    endless = not _counts_epochs(trainer)
    for callback in _callbacks(trainer):
        name = type(callback).__name__
        if isinstance(callback, BackboneFinetuning) and not hasattr(module, "backbone"):
            yield f"{name} needs a module with a backbone: train a pretrained emulator by EmulatorModule.of instead."
        if isinstance(callback, ModelPruning):
            yield f"{name}: masks on weights are not supported; choose a network with fewer channels."
        if isinstance(callback, StochasticWeightAveraging) and endless:
            yield f"{name} {_COUNT_EPOCHS}, or take EMAWeightAveraging(use_buffers=False)."
        if isinstance(callback, GradientAccumulationScheduler) and endless and max(callback.scheduling) > 0:
            yield f"{name} from epoch {max(callback.scheduling)} on {_COUNT_EPOCHS}, or accumulate_grad_batches."
        if (
            isinstance(callback, WeightAveraging)
            and callback._use_buffers
            and not (callback._kwargs.get("avg_fn") or callback._kwargs.get("multi_avg_fn"))
        ):
            yield f"{name}: give use_buffers=False; normalisation statistics are constants, which have no average."


def _counts_epochs(trainer: Trainer) -> bool:
    return isinstance(trainer.limit_train_batches, int)


def _callbacks(trainer: Trainer) -> list[object]:
    return list(trainer.callbacks)  # type: ignore[attr-defined]  # (Lightning sets it)


# Precision


def fitting_precision(precision: str, device: torch.device) -> str:
    """The precision itself, or float32 in place of mixed bfloat16 on a device that emulates it."""
    return FLOAT32 if precision in BFLOAT16 and not computes_bfloat16(device) else precision


def warn_of_slow_precision(trainer: Trainer) -> None:
    """Warn where a trainer is about to train in emulated bfloat16."""
    if fitting_precision(str(trainer.precision), trainer.strategy.root_device) != trainer.precision:
        rank_zero_warn(
            f"bfloat16 is emulated on this processor, so that {trainer.precision} takes many times as long as float32:"
            f' give the trainer precision="{FLOAT32}".'
        )


def _check_precision(trainer: Trainer) -> None:
    converted = trainer.precision_plugin.convert_input(torch.zeros(1, dtype=torch.float32)).dtype
    if torch.finfo(converted).bits < 32:
        name = str(converted).removeprefix("torch.")
        raise ConfigError(
            f"precision={trainer.precision}: positions in {name} would be off by whole cells. Give"
            ' precision="bf16-mixed", in which only the network computes in bfloat16, or "32-true".'
        )


# Evaluations and monitored errors


def check_evaluations(
    trainer: Trainer, module: LightningModule, valid: Comparison, test: Comparison, data: TrajectoryDataModule
) -> None:
    """Compute the metrics of validations and tests on a trajectory, and look for the errors that callbacks monitor.

    Raises:
        ConfigError: where Lightning would fail in the first validation, or after the training.
    """
    if trainer.enable_validation:
        _check_share("limit_val_batches", trainer.limit_val_batches, len(data.val_dataloader()))
        errors = _try_metrics(valid, data.recordings("valid"))
        _check_monitors(trainer, module, {*errors, OVERALL})
    if data.has_test and trainer.limit_test_batches:
        _check_share("limit_test_batches", trainer.limit_test_batches, len(data.test_dataloader()))
        # Two frames and one to predict: the metrics of a test may take minutes for a whole trajectory.
        _try_metrics(test, data.recordings("test"), frames=3)


def _check_share(option: str, share: float, batches: int) -> None:
    if isinstance(share, float) and 0 < share * batches < 1:
        raise ConfigError(
            f"--trainer.{option} {share} of {batches} batches is none: give a larger share, or a whole number of"
            " batches."
        )


def _check_monitors(trainer: Trainer, module: LightningModule, errors: set[str]) -> None:
    """Raise ConfigError if what callbacks monitor is never logged; the user's callbacks or module may log anything."""
    if not all(type(part).__module__.startswith(PACKAGES) for part in (module, *_callbacks(trainer))):
        return
    names = ["train/loss", *sorted(f"valid/{name}" for name in errors)]
    for callback in _callbacks(trainer):
        monitor = getattr(callback, "monitor", None)
        if monitor is not None and monitor not in names:
            raise ConfigError(
                f"{type(callback).__name__} monitors {monitor}, which is never logged; there are {', '.join(names)}."
                f"{suggestion(monitor, names)}"
            )


def _try_metrics(errors: Comparison, recordings: SplitRecordings, frames: int | None = None) -> Sequence[str]:
    """Names of the errors of a motionless rollout of the longest trajectory; ConfigError if a metric fails on it."""
    split = recordings.split
    index = min(recordings.indices, key=lambda number: (-split.frames(number), split.particles(number)))
    window = collate([recordings.at(index)], recordings.reading, frames)
    count = window.target.shape[1]
    fields = {name: values.unsqueeze(1).expand(-1, count, -1) for name, values in window.initial.fields.items()}
    trial = copy.deepcopy(errors).cpu()
    for part in trial.modules():
        if isinstance(part, Metric):
            part.sync_on_compute = False
    try:
        trial.update(window, still(window.initial, count), fields)
        return list(trial.compute())
    except NmpmError:
        raise
    except Exception as error:  # metrics of users raise anything
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise ConfigError(f"model.metrics cannot be computed on {split.where(index)} ({reason}).") from error


# Memory and disk space


def check_memory(trainer: Trainer, emulator: Emulator, bundles: int, batch_size: int) -> None:
    """Raise ConfigError, with a grid that fits, if a U-Net's activations do not fit into the memory."""
    recipe, scene = emulator.recipe, emulator.scene
    if trainer.strategy.root_device.type != "cpu" or not isinstance(recipe.processor, UNet):
        return
    size = TrainingSize(batch_size, bundles, recipe.processor.width)
    free = free_memory()

    def fits(shape: Sequence[int]) -> bool:
        return size.memory(shape) <= MEMORY_MARGIN * free

    if fits(emulator.grid.shape):
        return
    numbers = range(MULTIPLE, max(emulator.grid.shape), MULTIPLE)
    smaller = [cells for cells in numbers if fits(grid_shape(scene.domain, scene.periodic, cells))]
    shape = " x ".join(map(str, emulator.grid.shape))
    raise ConfigError(
        f"A training on {shape} cells takes about {size.memory(emulator.grid.shape) / 1e9:.0f} GB of memory, of"
        f" which {free / 1e9:.1f} are free: give --model.cells {max(smaller, default=MULTIPLE)}, a smaller"
        f" --data.batch_size than {batch_size}, or --model.recompute true."
    )


def check_disk(trainer: Trainer, module: LightningModule) -> None:
    """Raise ConfigError if checkpoints and report do not fit on the disk; warn if they fit only once."""
    savers = [saver for saver in trainer.checkpoint_callbacks if isinstance(saver, ModelCheckpoint)]
    # Each file is written beside the one that it replaces.
    files = 1 + sum(max(saver.save_top_k, 1) + bool(saver.save_last) for saver in savers)
    weights = sum(weight.numel() * weight.element_size() for weight in module.parameters())
    needed = files * CHECKPOINT_SIZE * weights + REPORT_BYTES
    for folder in {Path(trainer.default_root_dir), *(Path(saver.dirpath) for saver in savers if saver.dirpath)}:
        existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.is_dir())
        free = shutil.disk_usage(existing).free
        message = (
            f"{folder}: {free >> 20} MB of disk are free; checkpoints and report need up to {needed >> 20} MB."
            f" {_ELSEWHERE}"
        )
        if free < needed:
            raise ConfigError(message)
        if not _is_granted(existing, needed):
            raise ConfigError(f"{folder}: your quota there, or the disk, has no {needed >> 20} MB left. {_ELSEWHERE}")
        if free < 2 * needed:
            rank_zero_warn(message)


def _is_granted(folder: Path, size: int) -> bool:
    """Whether the system lets a file of so many bytes be made in a folder; True where it cannot tell."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        return error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    except AttributeError:  # not on macOS
        pass
    return True


def compile_network(network: GridProcessor, grid: Tensor) -> bool:
    """Compile a network in place, so that names of weights stay, and try it on a grid state (B, C_in, *S).

    Returns:
        Whether it is compiled. Without a compiler, or if the network cannot be traced, it stays as it was.
    """
    network.compile()
    try:
        with torch.no_grad():
            network(grid)
    except Exception as error:  # (compilers document no exceptions)
        network._compiled_call_impl = None
        _LOG.warning("The network is not compiled: %s", str(error).splitlines()[0][:200])
        return False
    return True
