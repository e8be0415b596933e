"""Runs a training command: how configurations are read and kept, signals, exit status, the lock of the run's folder."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from jsonargparse import ArgumentParser, get_loader, set_loader, set_parsing_settings
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.cli import SaveConfigCallback
from yaml import YAMLError

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import check_yaml
from nmpm._support.messages import one_line
from nmpm._support.plain_data import load_plugins
from nmpm.cli import expand_home
from nmpm.cli.console import quiet_lightning
from nmpm.cli.early_checks import UsageError
from nmpm.cli.emulator_cli import EmulatorCLI
from nmpm.cli.match_options import MatchOptions
from nmpm.cli.run_folder import CHECKPOINTS, CONFIG, SAVERS
from nmpm.cli.trust import foreign_names, trust_advice
from nmpm.errors import ConfigError

PARSER_MODE = "omegaconf+"
ArgumentParser(parser_mode=PARSER_MODE).parse_string("{}")  # makes jsonargparse set the mode's loader
_load = get_loader(PARSER_MODE)


def load_checked(text: str) -> Any:
    """Read a configuration's text, in which ${…} may refer to its other keys, but not to anything else.

    Raises:
        ValueError: for what `check_yaml` refuses, and resolvers, such as `${oc.env:HOME}`, as runs are shared.
        YAMLError: if it is not YAML.
    """
    check_yaml(text)
    value = _load(text)
    rest, count = str(value), 1
    while count:  # from the inside to the outside
        rest, count = re.subn(r"\$\{[^${}:]*\}", "", rest)
    if left := re.search(r"\$\{[^}]*\}?", rest):
        raise ValueError(f"{one_line(left[0], 60)}: ${{…}} refers to other keys of the configuration, to nothing else.")
    return _with_home(value)


def _with_home(value: Any) -> Any:
    """What a configuration holds, with the home folder for a `~` that begins a text."""
    if isinstance(value, dict):
        return {key: _with_home(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_with_home(one) for one in value]
    return expand_home(value) if isinstance(value, str) else value


def load_shared(text: str, trusted: frozenset[str]) -> Any:
    """As `load_checked`, of a run that others may have written, whose files name known and trusted classes only.

    Raises:
        UsageError: for other names (a ValueError would have the parser take the text for another value).
    """
    content = load_checked(text)
    for name in foreign_names(content, trusted) if isinstance(content, dict | list) else ():
        raise UsageError(f"the run's configuration {trust_advice(name)}")
    return content


def run_command(words: list[str], note: str = "", trusted: frozenset[str] | None = None) -> int:
    """Run a training command, which prints the note when it starts; return the exit status.

    Args:
        words: Of the command line.
        note: What to print.
        trusted: Names in the user's own options, where others may have written the configuration.

    Raises:
        UsageError: for an option or key that cannot be.
        ConfigError: if Lightning refuses the configuration.
        KeyboardInterrupt: at SIGINT and SIGTERM, saying how to go on.
    """
    load_plugins()
    set_parsing_settings(omegaconf_absolute_to_relative_paths=True)
    load = load_checked if trusted is None else partial(load_shared, trusted=trusted)
    set_loader(PARSER_MODE, load, (YAMLError, ValueError, RecursionError))
    # Not as `args`: Lightning starts further processes by the command line, and warns where the two differ.
    sys.argv = [sys.argv[0], *words]
    locks: list[int] = []
    try:
        with quiet_lightning(), _treat_sigterm_like_sigint():
            EmulatorCLI(
                words[0],
                note,
                locks,
                seed_everything_default=0,
                parser_kwargs={"parser_mode": PARSER_MODE},
                save_config_callback=RunConfig,
                save_config_kwargs={"save_to_log_dir": False},
            )
    except MisconfigurationException as error:
        raise ConfigError(" ".join(str(error).split())) from error
    except SystemExit as ended:
        if isinstance(ended.__context__, KeyboardInterrupt):  # Lightning's answer to it
            raise ended.__context__ from None
        raise
    finally:
        for descriptor in locks:
            os.close(descriptor)
    return 0


@contextmanager
def _treat_sigterm_like_sigint() -> Iterator[None]:
    """Turn SIGTERM into KeyboardInterrupt, as SIGINT is."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, former)


class RunConfig(SaveConfigCallback):
    """Writes a training's configuration into the run's folder, such that `nmpm test RUN` works from anywhere."""

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:  # noqa: ARG002
        if stage != "fit":
            return
        config, root = self.config.clone(), Path(self.config["trainer"]["default_root_dir"])
        config["ckpt_path"] = None
        for name in ("start_from", *MatchOptions._fields):  # of the start alone
            config.pop(name, None)
        for saver in SAVERS.values():
            folder = Path(config[saver]["dirpath"])
            config[saver]["dirpath"] = None if folder == root / CHECKPOINTS else str(folder.absolute())
        if config["data"]["path"]:
            config["data"]["path"] = str(Path(config["data"]["path"]).absolute())
        with atomic_write(root / CONFIG) as part:
            part.write_text(self.parser.dump(config, skip_none=False), encoding="utf-8")
