"""Lightning without the messages and warnings that belong to every run."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from nmpm._support.messages import plain_warnings

REMARKS = re.compile(
    r"(\[rank: \d+\] )?Seed set to"
    r"|Found current_model_state in the checkpoint"
    r"|Using .*(Automatic Mixed Precision|precision)"
    r"|(GPU|TPU|HPU|IPU) available: "
    r"|LOCAL_RANK: "
    r"|You are using a CUDA device"
    r"|.{0,3}Tip: For seamless cloud"
    r"|Loading `train_dataloader` to estimate"
    r"|Initializing distributed: "
    r"|-+\ndistributed_backend="
    r"|Restor(ing|ed all) states from"
    r"|Loaded model weights from"
    r"|`Trainer\.fit` stopped: "
    r"|Time limit reached\."
    r"|\s*Detected KeyboardInterrupt"
    r"|\[rank: \d+\] Received SIGTERM"
)
"""Messages that Lightning logs in the course of every run."""

WARNINGS = (
    r"`isinstance\(treespec, LeafSpec\)` is deprecated",
    r"Checkpoint directory .* exists and is not empty",
    r"Experiment logs directory .* exists and is not empty",
    r"Couldn't infer the batch indices fetched",
    r"It is recommended to use `self\.log\(.*sync_dist=True\)`",
    r"`max_epochs` was not set",
    r"The '\w+' does not have many workers",
    r"You're using the WeightAveraging callback, but loading a checkpoint outside",
    r"Be aware that when using `ckpt_path`, callbacks used to create the checkpoint",
    r"Precision .* is not supported by the model summary",
    r"You have overridden `on_before_batch_transfer` in `LightningModule`",
)
"""Lightning's warnings about what is meant to be so."""


def _is_no_remark(record: logging.LogRecord) -> bool:
    return not (record.name.startswith("lightning") and REMARKS.match(record.getMessage()))


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Hide `REMARKS` and `WARNINGS` while it lasts; everything else is shown, warnings without lines of code."""
    loggers = map(logging.getLogger, ("lightning.pytorch", "lightning.fabric", "lightning", ""))
    handlers = [handler for logger in loggers for handler in logger.handlers]
    with ExitStack() as undo, warnings.catch_warnings(), plain_warnings():
        for message in WARNINGS:
            warnings.filterwarnings("ignore", message, module=r"lightning\.")
        for handler in handlers:
            handler.addFilter(_is_no_remark)
            undo.callback(handler.removeFilter, _is_no_remark)
        yield
