"""What a training command shows: mistakes in one line with the nearest name, Lightning's remarks left out."""

from __future__ import annotations

import logging
import re
import sys
import traceback
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import NoReturn

from lightning.pytorch.cli import LightningArgumentParser

from nmpm._support.messages import plain_warnings
from nmpm._support.shipped import PACKAGE
from nmpm.cli.early_checks import UsageError, nearest

LONGEST = 300
"""Characters of a message of jsonargparse's that are shown."""

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


class _Remarks(logging.Filter):
    def filter(self, record: logging.LogRecord) -> bool:
        return not (record.name.startswith("lightning") and REMARKS.match(record.getMessage()))


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Hide `REMARKS` and `WARNINGS` while it lasts; everything else is shown, warnings without lines of code."""
    remarks = _Remarks()
    loggers = map(logging.getLogger, ("lightning.pytorch", "lightning.fabric", "lightning", ""))
    handlers = [handler for logger in loggers for handler in logger.handlers]
    with warnings.catch_warnings(), plain_warnings():
        for message in WARNINGS:
            warnings.filterwarnings("ignore", message, module=r"lightning\.")
        for handler in handlers:
            handler.addFilter(remarks)
        try:
            yield
        finally:
            for handler in handlers:
                handler.removeFilter(remarks)


class BriefParser(LightningArgumentParser):
    """Raises `UsageError` where jsonargparse would print its usage and exit."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        parser = getattr(ex, "subcommand_parser", None) or self
        names = [action.dest for action in parser._actions]
        raise UsageError(explain(message, names)) from ex


def explain(message: str, names: Iterable[str]) -> str:
    """A message of jsonargparse in one line, with the nearest of `names`, the parser's, where one is unknown."""
    if match := re.match(r"unrecognized arguments: --([\w.]+)", message):
        return f"there is no option --{match[1]}{nearest(match[1], names, '--')}"
    if match := re.match(r"Subcommand '\w+' does not accept option '([\w.]+)'", message):
        return f"the configuration has an unknown key {match[1]}{nearest(match[1], names, '')}"
    if match := re.match(r"Option '([\w.]+)' is not accepted", message):
        return f"the argument {match[1]} is unknown{nearest(match[1], names, '')}"
    key = re.match(r'Parser key "([\w.]+)":', message)
    option = f"--{key[1]}: " if key else ""
    if match := re.search(r"module '([\w.]+)' has no attribute '(\w+)'", message):
        public = [name for name in vars(sys.modules.get(match[1], object())) if not name.startswith("_")]
        near = get_close_matches(match[2], public, n=1)
        question = f"; did you mean {match[1]}.{near[0]}?" if near else "."
        return f"{option}there is no {match[1]}.{match[2]}{question}"
    if match := re.search(r"Expected a <class '(\w+)'>\.? Got value: (.*)", message):
        return f"{option}{match[2]} is not of type {match[1]}."
    if match := re.search(r"Expected a typing\.Literal\[(.*?)\]\.? Got value: (\S+)", message):
        return f"{option}{match[2]} is not one of {match[1]}."
    if match := re.search(r"Problem with given class_path '([\w.]+)':\s+(.+)", message):
        return f"{match[1]}: {match[2]}"
    rest = re.sub(r"- Expected a path but \S+ either not accessible or invalid", "", message[key.end() if key else 0 :])
    line = " ".join(rest.split()).removeprefix("- ")
    return option + (line if len(line) <= LONGEST else f"{line[:LONGEST]} …")


def is_of_other_packages(error: BaseException) -> bool:
    """Whether an error, and what it follows from, was raised by other packages, called by nothing but the CLI."""
    parts: set[Path] = set()
    following: BaseException | None = error
    while following is not None:
        parts |= {Path(frame.filename) for frame in traceback.extract_tb(following.__traceback__)}
        following = following.__cause__ or following.__context__
    return not any(path.is_relative_to(PACKAGE) and not path.is_relative_to(PACKAGE / "cli") for path in parts)
