"""Runs a training command: start, end and interruptions of a fit, signals, exit status, the lock of its folder."""

from __future__ import annotations

import os
import re
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from jsonargparse import ArgumentParser, get_loader, set_loader, set_parsing_settings
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import BatchSizeFinder
from lightning.pytorch.utilities import rank_zero_only
from yaml import YAMLError

from nmpm._support.bounded_files import check_yaml
from nmpm._support.collectives import describe_ended_rank, is_lost_connection
from nmpm._support.devices import device_name
from nmpm._support.messages import one_line
from nmpm._support.plain_data import load_plugins
from nmpm.cli.console import quiet_lightning
from nmpm.cli.emulator_cli import ConfiguredCLI, RunConfig
from nmpm.cli.options import check_folder
from nmpm.errors import ConfigError, NmpmError
from nmpm.training.budget import check_endless_batches
from nmpm.training.callbacks.savers import BestCheckpoint, LastCheckpoint
from nmpm.training.checkpoints import check_same_recipe, read_checkpoint
from nmpm.training.preflight import check_disk
from nmpm.zoo.registry import load_model

T = TypeVar("T")

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
    return value


def run_command(words: list[str], note: str = "") -> int:
    """Run a training command.

    Args:
        words: The command and its options, with the configuration files' paths.
        note: A line to print when it starts.

    Returns:
        The exit status.

    Raises:
        UsageError: for an option or key that cannot be.
        ConfigError: if Lightning refuses the configuration.
        KeyboardInterrupt: at SIGINT and SIGTERM, saying how to go on.
    """
    load_plugins()
    set_parsing_settings(omegaconf_absolute_to_relative_paths=True)
    set_loader(PARSER_MODE, load_checked, (YAMLError, ValueError, RecursionError))
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


class EmulatorCLI(ConfiguredCLI):
    """Runs fit, validate, test or predict; a fit ends with a test.

    Args:
        command: Which one.
        note: A line to print when it starts; may be empty.
        locks: A list that the descriptor of the run folder's lock is appended to. (Callbacks that copy the module copy
            this object too, so it must not hold what cannot be copied.)
        options: Of LightningCLI.
    """

    def __init__(self, command: str, note: str, locks: list[int], **options: Any) -> None:
        self.note, self.locks, self.parent = note, locks, os.getppid()
        super().__init__(command, **options)

    def before_fit(self) -> None:
        """Check, before data are simulated, that the training can run, and lock the run's folder.

        Raises:
            ConfigError: if the training has no end, another process trains in the folder, it holds a run that is not
                to go on, or the checkpoint has other parts.
            DataError: if the checkpoint cannot be read.
        """
        config = self.config_init[self.subcommand]
        check_endless_batches(self.trainer)
        for logger in self.trainer.loggers:
            check_folder("The logger's save_dir", Path(logger.save_dir or "."))
        check_disk(self.trainer, self.model)
        resumed = self._load_checkpoint()
        if resumed is not None:
            self.model.adopt_arguments(resumed)  # refuses another optimizer before data are simulated
        elif config.get("start_from"):
            self._load_initial_weights(str(config["start_from"]))
        if rank_zero_only.rank:  # type: ignore[attr-defined]  # (Lightning sets it)
            return
        self.locks.append(self.run_folder.lock())
        self.run_folder.remove_unfinished()
        if resumed is None or not self.run_folder.holds(Path(config["ckpt_path"])):
            self.run_folder.check_new()
        self._print_start(f"Files: {self.run_folder.root}. Ctrl-C stops after a step, to go on later.\n")

    def before_validate(self) -> None:
        self._load_checkpoint()
        if not rank_zero_only.rank:  # type: ignore[attr-defined]  # (Lightning sets it)
            self._print_start()

    before_test = before_predict = before_validate

    def _print_start(self, more: str = "") -> None:
        device, emulator = self.trainer.strategy.root_device, self.model.emulator
        hardware = self.threads.describe(self.trainer) if device.type == "cpu" else device_name(device)
        weights = sum(parameter.numel() for parameter in emulator.parameters())
        precision = "bfloat16 is emulated on this processor; training in float32.\n" if self.bfloat16_replaced else ""
        sys.stdout.write(
            f"{self.note}Data: {self.datamodule.description}. Model: {type(emulator.recipe.processor).__name__},"
            f" {weights:,} parameters, on {hardware}.\n{precision}{more}"
        )
        sys.stdout.flush()

    def fit(self, **options: Any) -> None:
        """Train, then test the best weights; an interruption, or the end of another rank, says how to go on.

        Raises:
            KeyboardInterrupt: at SIGINT and SIGTERM.
            NmpmError: if another rank has ended.
        """
        try:
            self.trainer.fit(**options)
            self._test_best_weights()
        except SystemExit as ended:
            if not isinstance(ended.__context__, KeyboardInterrupt):
                raise
            if self.trainer.is_global_zero:
                raise KeyboardInterrupt(self._how_to_go_on()) from None
            raise SystemExit(130) from None
        except RuntimeError as error:
            if not is_lost_connection(error):
                raise
            raise self._lost_rank_error() from None

    def _lost_rank_error(self) -> BaseException:
        """Names the rank that has ended, on one of those that are left: rank 0, or rank 1 where rank 0 has."""
        if self.trainer.is_global_zero:
            ended = describe_ended_rank(getattr(self.trainer.strategy.launcher, "procs", []))
        elif self.trainer.global_rank == 1 and os.getppid() != self.parent:
            ended = f"rank 0 (process {self.parent}) has ended"
        else:
            return SystemExit(1)
        return NmpmError(f"{ended}: {self._how_to_go_on()}")

    def _how_to_go_on(self) -> str:
        if not self.run_folder.checkpoints["last"].is_file():
            return "interrupted before the first step. The same command starts again; simulated trajectories are kept."
        step = self._saver(LastCheckpoint).saved_step
        stopped = f"stopped at step {step}" if step else "interrupted"
        return f"{stopped}. Go on with: {shlex.join(['nmpm', 'fit', '--resume', str(self.run_folder.root)])}"

    def _test_best_weights(self) -> None:
        """Validate the last weights too, if no validation has, and test the best ones, once.

        Where validations are turned off, the last weights are tested; without a test, the report says why.
        """
        callbacks = self.trainer.callbacks  # type: ignore[attr-defined]  # (Lightning sets it)
        callbacks[:] = [one for one in callbacks if not isinstance(one, BatchSizeFinder)]  # (it would act here, too)
        best = self._saver(BestCheckpoint)
        if best.monitor and self.trainer.limit_val_batches and best.scored_step < self.trainer.global_step:
            self.trainer.validate(self.model, datamodule=self.datamodule, verbose=False)
            best.score(self.trainer)
        # Not by `ckpt_path`, from which a WeightAveraging callback that has just trained takes the raw weights.
        path = Path(best.best_model_path or self.run_folder.checkpoints["last"])
        if path.is_file():
            self.model.load_state_dict(read_checkpoint(path)["state_dict"])
        untested = "" if self.trainer.limit_test_batches else "--trainer.limit_test_batches is 0."
        if not self.datamodule.has_test:
            untested = f"{self.datamodule.data_source.folder} has no test.h5."
        if untested:
            self.report.report_untested(self.trainer, self.model, untested)
        else:
            self.trainer.test(self.model, datamodule=self.datamodule, verbose=False)

    def _saver(self, kind: type[T]) -> T:
        return next(callback for callback in self.trainer.checkpoint_callbacks if isinstance(callback, kind))

    def _load_checkpoint(self) -> dict[str, Any] | None:
        """The checkpoint that --ckpt_path names, whose parts are the model's; None without the option."""
        path = self.checkpoint_path()
        if path is None:
            return None
        content = read_checkpoint(path)
        self.model.on_load_checkpoint(content)
        self.config_init[self.subcommand]["ckpt_path"] = str(path)
        return content

    def _load_initial_weights(self, name: str) -> None:
        """Give the model the weights and statistics of another one with the same parts, over the data's scene."""
        emulator = self.model.emulator
        initial = load_model(name).emulator.over(emulator.scene)
        check_same_recipe(initial.recipe.to_dict(), emulator.recipe)
        emulator.load_state_dict(initial.state_dict())
