"""What a training command shows: Lightning's advertisements and remarks about its own internals are left out."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

REMARKS = re.compile(
    "|".join(
        (
            r"(\[rank: \d+\] )?Seed set to",
            r"Found current_model_state in the checkpoint",
            r"Using .*(Automatic Mixed Precision|precision)",
            r"(GPU|TPU|HPU|IPU) available: ",
            r"LOCAL_RANK: ",
            r"You are using a CUDA device",
            r".{0,3}Tip: For seamless cloud",
            r"Loading `train_dataloader` to estimate",
            r"Initializing distributed: ",
            r"-+\ndistributed_backend=",
            r"Restor(ing|ed all) states from",
            r"Loaded model weights from",
            r"`Trainer\.fit` stopped: ",
            r"Time limit reached\.",
            r"\s*Detected KeyboardInterrupt",
            r"\[rank: \d+\] Received SIGTERM",
        )
    )
)
"""Messages that Lightning logs in the course of every run."""

WARNINGS = (
    (r"`isinstance\(treespec, LeafSpec\)` is deprecated", r"lightning\."),
    (r"Checkpoint directory .* exists and is not empty", r"lightning\."),
    (r"Experiment logs directory .* exists and is not empty", r"lightning\."),
    (r"Couldn't infer the batch indices fetched", r"lightning\."),
    (r"It is recommended to use `self\.log\(.*sync_dist=True\)`", r"lightning\."),
    (r"`max_epochs` was not set", r"lightning\."),
    (r"The '\w+' does not have many workers", r"lightning\."),
    (r"You're using the WeightAveraging callback, but loading a checkpoint outside", r"lightning\."),
    (r"Be aware that when using `ckpt_path`, callbacks used to create the checkpoint", r"lightning\."),
    (r"Precision .* is not supported by the model summary", r"lightning\."),
)
"""Messages and modules of warnings about what is meant to be so."""


class _Remarks(logging.Filter):
    def filter(self, record: logging.LogRecord) -> bool:
        return not (record.name.startswith("lightning") and REMARKS.match(record.getMessage()))


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Hide `REMARKS` and `WARNINGS` while it lasts; everything else is shown."""
    remarks = _Remarks()
    handlers = [handler for name in ("lightning.pytorch", "lightning.fabric", "lightning", "") for handler in
                logging.getLogger(name).handlers]  # fmt: skip
    with warnings.catch_warnings():
        for message, module in WARNINGS:
            warnings.filterwarnings("ignore", message, module=module)
        for handler in handlers:
            handler.addFilter(remarks)
        try:
            yield
        finally:
            for handler in handlers:
                handler.removeFilter(remarks)
