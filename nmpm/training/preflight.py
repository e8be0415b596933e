"""Checks, before the first step, of what a training needs at its end: metrics, monitors and disk space."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Sequence
from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_warn
from torchmetrics import Metric

from nmpm._support.messages import one_line, suggestion
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import SplitRecordings
from nmpm.errors import ConfigError, NmpmError
from nmpm.evaluation.baselines import still
from nmpm.evaluation.comparison import Comparison
from nmpm.training.module import OVERALL, EmulatorModule
from nmpm.training.trainer_checks import may_log_more

CHECKPOINT_SIZE = 5
"""Bytes of a checkpoint for each of the weights', at most: averaged ones and the state of SOAP or Adam with them."""

REPORT_BYTES = 32 * 2**20
"""Of the report with its pictures, and of logs."""


class Preflight(Callback):
    """Tries the metrics on a trajectory of each split, and looks for the errors by which callbacks choose.

    Raises:
        ConfigError: if a metric does not take the data, a share of a split's batches is none, or the error that a
            callback monitors is never logged.
    """

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        data = trainer.datamodule  # type: ignore[attr-defined]  # (Lightning sets it)
        if stage != "fit" or not isinstance(pl_module, EmulatorModule) or not isinstance(data, TrajectoryDataModule):
            return
        if trainer.enable_validation:
            check_share("limit_val_batches", trainer.limit_val_batches, len(data.val_dataloader()))
            names = _try_metrics(pl_module.valid_errors, data.data_source.recordings("valid"))
            check_monitors(trainer, pl_module, {*names, OVERALL})
        if data.has_test and trainer.limit_test_batches:
            check_share("limit_test_batches", trainer.limit_test_batches, len(data.test_dataloader()))
            # Two frames and one to predict: the metrics of a test may take minutes for a whole trajectory.
            _try_metrics(pl_module.test_errors, data.data_source.recordings("test"), frames=3)


def check_share(option: str, share: float, batches: int) -> None:
    """Make sure that a share of a split's batches is at least one; Lightning finds out when it evaluates.

    Raises:
        ConfigError: if it is none.
    """
    if isinstance(share, float) and 0 < share * batches < 1:
        raise ConfigError(
            f"--trainer.{option} {share} of {batches} batches is none: give a larger share, or a whole number of"
            " batches."
        )


def check_monitors(trainer: Trainer, module: EmulatorModule, errors: set[str]) -> None:
    """Make sure that what callbacks monitor is logged; Lightning finds out after the first validation.

    Not where the user's callbacks or module may log more.

    Args:
        trainer: With the callbacks.
        module: Logs the errors.
        errors: Names of those that validations find.

    Raises:
        ConfigError: naming the errors that there are.
    """
    if may_log_more(trainer, module):
        return
    names = ["train/loss", *sorted(f"valid/{name}" for name in errors)]
    for callback in trainer.callbacks:  # type: ignore[attr-defined]  # (Lightning sets it)
        monitor = getattr(callback, "monitor", None)
        if monitor is not None and monitor not in names:
            raise ConfigError(
                f"{type(callback).__name__} monitors {monitor}, which is never logged; there are {', '.join(names)}."
                f"{suggestion(monitor, names)}"
            )


def check_disk(trainer: Trainer, module: LightningModule) -> None:
    """Make sure that checkpoints and report fit on the disk.

    Raises:
        ConfigError: if they do not.

    Warns:
        UserWarning: if they fit only once.
    """
    savers = [one for one in trainer.checkpoint_callbacks if isinstance(one, ModelCheckpoint)]
    # Each file is written beside the one that it replaces.
    files = 1 + sum(max(saver.save_top_k, 1) + bool(saver.save_last) for saver in savers)
    weights = sum(weight.numel() * weight.element_size() for weight in module.parameters())
    needed = files * CHECKPOINT_SIZE * weights + REPORT_BYTES
    for folder in {Path(trainer.default_root_dir), *(Path(saver.dirpath) for saver in savers if saver.dirpath)}:
        existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.is_dir())
        free = shutil.disk_usage(existing).free
        said = (
            f"{folder}: {free >> 20} MB of disk are free; checkpoints and report need up to {needed >> 20} MB. Free"
            " some, or write elsewhere with --trainer.default_root_dir."
        )
        if free < needed:
            raise ConfigError(said)
        if free < 2 * needed:
            rank_zero_warn(said)


def _try_metrics(errors: Comparison, recordings: SplitRecordings, frames: int | None = None) -> Sequence[str]:
    """Names of the errors of a rollout of the longest trajectory, the smallest of such, in which nothing moves.

    Raises:
        ConfigError: if a metric does not take it.
    """
    split = recordings.split
    index = min(range(len(split)), key=lambda one: (-split.frames(one), split.particles(one)))
    window = collate([recordings[index]], recordings.scene, frames)
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
