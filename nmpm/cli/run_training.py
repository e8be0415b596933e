"""Runs a training command by LightningCLI: the data's scene flows into the model, a run's files are in one folder."""

from __future__ import annotations

import operator
import re
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn, TypeVar, get_type_hints

from jsonargparse import ArgumentParser, get_loader, set_loader, set_parsing_settings
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import BatchSizeFinder, LearningRateMonitor, ProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.strategies.launchers import _MultiProcessingLauncher
from lightning.pytorch.utilities import rank_zero_only
from yaml import YAMLError

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import check_yaml
from nmpm._support.former import with_loss
from nmpm._support.machine import device_name, find_device
from nmpm._support.messages import one_line
from nmpm._support.plain_data import load_plugins
from nmpm._support.shipped import PACKAGE
from nmpm._support.threads import stated_threads
from nmpm.cli import COMMANDS, expand_home
from nmpm.cli.command import UsageError, argument_texts, explain
from nmpm.cli.matched_run import MatchedRun, stored_scene
from nmpm.cli.options import MatchOptions, check_folder
from nmpm.cli.run_folder import CHECKPOINTS, CONFIG, SAVERS, RunFolder, next_folder
from nmpm.cli.training_options import known_options, read_config
from nmpm.cli.trust import OPTION, foreign_names, trust_advice
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.inspection import contradictions_warning
from nmpm.data.sources import FolderSource
from nmpm.errors import ConfigError, NmpmError
from nmpm.scene import Scene
from nmpm.training.budget import check_endless_batches
from nmpm.training.callbacks.divergence import DivergenceGuard
from nmpm.training.callbacks.forecast import Forecast
from nmpm.training.callbacks.outputs import PredictionWriter, ReportWriter
from nmpm.training.callbacks.progress import Progress
from nmpm.training.callbacks.savers import DEFAULTS, BestCheckpoint, LastCheckpoint
from nmpm.training.callbacks.threads import Threads
from nmpm.training.checkpoints import AtomicCheckpointIO, read_checkpoint
from nmpm.training.module import EmulatorModule
from nmpm.training.optimization import check_learning_rate
from nmpm.training.preflight import check_disk, check_memory, fitting_precision
from nmpm.training.quiet import quiet_lightning
from nmpm.training.rank_watch import RankWatch, is_lost_connection


class BriefParser(LightningArgumentParser):
    """Raises `UsageError` where jsonargparse would print its usage and exit."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        parser = getattr(ex, "subcommand_parser", None) or self
        names = [action.dest for action in parser._actions]
        raise UsageError(explain(message, names, known_options()["parts"])) from ex


def is_of_other_packages(error: BaseException) -> bool:
    """Whether an error, and what it follows from, was raised by other packages, called by nothing but the CLI."""
    parts: set[Path] = set()
    following: BaseException | None = error
    while following is not None:
        parts |= {Path(frame.filename) for frame in traceback.extract_tb(following.__traceback__)}
        following = following.__cause__ or following.__context__
    return not any(path.is_relative_to(PACKAGE) and not path.is_relative_to(PACKAGE / "cli") for path in parts)


OWN = ("materials", "stride", "strict", "start_from", "members", "threads")
"""Options of the commands that LightningCLI lacks."""
T = TypeVar("T")


class EmulatorCLI(LightningCLI):
    """Runs fit, validate, test or predict as a configuration says; a fit ends with a test.

    The run folder is locked until `locks` are closed; the `note` is printed at the start.
    """

    def __init__(self, command: str, note: str, locks: ExitStack, **options: Any) -> None:
        self.command, self.note, self.locks = command, note, locks
        self.kind = COMMANDS[command]
        self.own = [name for name in OWN if name in self.kind.__dataclass_fields__]
        self.bfloat16_replaced = False
        self.former = ""
        super().__init__(EmulatorModule, TrajectoryDataModule, **options)

    # Parser

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override]  # (static there)
        """The one that is run: parsers of the others would cost seconds."""
        return {self.command: LightningCLI.subcommands()[self.command]}

    def init_parser(self, **options: Any) -> LightningArgumentParser:
        """A parser whose errors are one line."""
        parser = BriefParser(**options)
        parser.add_argument("-c", "--config", action="config", help="Path to a configuration file in yaml format.")
        return parser

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        for name, (kind, defaults) in DEFAULTS.items():
            parser.add_lightning_class_args(kind, SAVERS[name])
            given = defaults | {"filename": name, "enable_version_counter": False}
            parser.set_defaults({f"{SAVERS[name]}.{key}": value for key, value in given.items()})
        hints, texts = get_type_hints(self.kind), argument_texts(self.kind)
        for name in self.own:
            default = self.kind.__dataclass_fields__[name].default
            parser.add_argument(f"--{name}", type=hints[name], default=default, help=texts[name])
        parser.link_arguments("data.scene", "model.scene", apply_on="instantiate", compute_fn=self._model_scene)
        parser.link_arguments(("model.frames", "model.unroll"), "data.horizon", compute_fn=operator.mul)

    def _model_scene(self, scene: Scene) -> Scene:
        """The data's scene, with fields of the checkpoint under evaluation that the data lack."""
        path = None if self.subcommand == "fit" else self.checkpoint_path()
        stored = stored_scene(path) if path else None
        return scene.with_fields_of(stored) if stored else scene

    def _parse_ckpt_path(self) -> None:
        """The configuration is the truth: a checkpoint's stored hyperparameters do not silently override it."""

    # Data, model and trainer

    def before_instantiate_classes(self) -> None:
        """Check and complete the configuration."""
        config = self.config[self.subcommand]
        trainer, optimizer = config["trainer"], config["model"].get("optimizer")
        config["weights_only"] = True  # checkpoints are read as tensors and plain data
        trainer["default_root_dir"] = trainer["default_root_dir"] or "runs/default"
        if self.subcommand == "fit" and not self._goes_on():
            root, self.former = next_folder(Path(trainer["default_root_dir"]))
            trainer["default_root_dir"] = str(root)
        check_folder("--trainer.default_root_dir", Path(trainer["default_root_dir"]))
        if self.subcommand != "fit" and not config["ckpt_path"]:
            raise ConfigError(
                "--ckpt_path is missing, so the model would be an untrained one: give best or last, of"
                f" {trainer['default_root_dir']}, or a checkpoint's file; or call nmpm {self.subcommand} RUN, with"
                " the folder of a run."
            )
        if "verbose" in config:
            config["verbose"] = False  # Lightning's own table, as ReportWriter prints ours
        if trainer["barebones"] or trainer["enable_checkpointing"] is False:
            raise ConfigError(
                "nmpm fit saves, logs and tests: for a bare Trainer, train from Python (docs/lightning.md)."
            )
        if isinstance(configured := trainer["precision"], str) and trainer["accelerator"] in ("auto", "cpu"):
            trainer["precision"] = fitting_precision(configured, find_device(trainer["accelerator"]))
            self.bfloat16_replaced = trainer["precision"] != configured
        trainer["enable_model_summary"] = bool(trainer["enable_model_summary"])  # the first line says its size
        for saver in SAVERS.values():
            folder = Path(trainer["default_root_dir"]) / CHECKPOINTS
            config[saver]["dirpath"] = config[saver]["dirpath"] or str(folder)
            if self.subcommand == "fit":
                check_folder(f"--{saver}.dirpath", Path(config[saver]["dirpath"]))
        if isinstance(optimizer, dict) or hasattr(optimizer, "get"):
            check_learning_rate((optimizer.get("init_args") or {}).get("lr"))
        options: Any = self.kind(**{name: config[name] for name in self.own})
        checkpoint = None if self.subcommand == "fit" else self.checkpoint_path()
        self.matched = MatchedRun.of(config, options.match, checkpoint)
        if self.matched is not None:
            self.matched.complete(config)

    def _add_instantiators(self) -> None:
        """Nothing: the model stores its own hyperparameters."""

    def instantiate_classes(self) -> None:
        """Make data, model and trainer; ConfigError says what Lightning, or a package of loggers, does not take."""
        try:
            # As Lightning does, by the method of jsonargparse that is not deprecated.
            self.config_init = self.parser.instantiate(self.config)
            self.datamodule, self.model = (self.config_init[self.subcommand][name] for name in ("data", "model"))
            self._add_configure_optimizers_method_to_model(self.subcommand)
            self.trainer = self.instantiate_trainer()
        except Exception as error:  # (other packages document none)
            if isinstance(error, NmpmError) or not is_of_other_packages(error):
                raise
            raise ConfigError(explain(str(error), (), known_options()["parts"])) from error

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """The trainer, with CSV and TensorBoard logs in the run's folder unless the configuration says otherwise."""
        config = self.config_init[self.subcommand]["trainer"]
        configured = config.get("callbacks") or []
        # What is given to Lightning's method replaces what is configured.
        callbacks = [*(configured if isinstance(configured, list) else [configured]), *kwargs.get("callbacks", [])]
        if config.get("logger") in (None, True):
            table = CSVLogger(config["default_root_dir"], name="logs")
            kwargs["logger"] = [table]
            if find_spec("tensorboard") is not None:
                kwargs["logger"] += [TensorBoardLogger(table.root_dir, name="", version=table.version)]
            callbacks.append(LearningRateMonitor("step"))
        callbacks.append(Forecast())  # whose lines come before the bar's
        if config.get("enable_progress_bar") is not False and not any(isinstance(c, ProgressBar) for c in callbacks):
            callbacks.append(Progress())
        self.report = ReportWriter()
        self.threads = Threads(stated_threads(self.config_init[self.subcommand]["threads"]))
        kwargs["callbacks"] = [*callbacks, self.threads, DivergenceGuard(), self.report, PredictionWriter()]
        trainer = super().instantiate_trainer(**kwargs)
        if isinstance(trainer.strategy.launcher, _MultiProcessingLauncher):
            raise ConfigError(f"--trainer.strategy {config['strategy']} is for notebooks: give ddp.")
        if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:
            trainer.strategy.checkpoint_io = AtomicCheckpointIO()
        if "logger" not in kwargs:
            for logger in trainer.loggers:  # some ask for an account, better before data are simulated
                getattr(logger, "experiment", None)
        return trainer

    @property
    def run_folder(self) -> RunFolder:
        """Where this run's files are."""
        config = self.config[self.subcommand]
        return RunFolder.of(Path(config["trainer"]["default_root_dir"]), config)

    def checkpoint_path(self) -> Path | None:
        """The file of the option --ckpt_path; None without it."""
        stated = self.config[self.subcommand]["ckpt_path"]
        if not stated:
            return None
        return self.run_folder.checkpoint(stated) if stated in SAVERS else Path(stated)

    def _goes_on(self) -> bool:
        """Whether a fit goes on with a run of its folder, instead of starting a new one."""
        path = self.config[self.subcommand]["ckpt_path"]
        return bool(path) and (path in SAVERS or self.run_folder.holds(Path(path)))

    # Runs

    def before_fit(self) -> None:
        """Check, before data are simulated, that the training can run, and lock the run's folder."""
        check_endless_batches(self.trainer)
        for logger in self.trainer.loggers:
            check_folder("The logger's save_dir", Path(logger.save_dir or "."))
        check_disk(self.trainer, self.model)
        bundles = 1 if self.model.recompute else self.model.unroll
        check_memory(self.trainer, self.model.emulator, bundles, self.datamodule.batch_size)
        resumed = self._load_checkpoint()
        if resumed is not None:
            self.model.adopt_arguments(resumed)  # refuses another optimizer before data are simulated
        elif self.matched is not None:
            self.model.emulator.load_state_dict(self.matched.model.emulator.state_dict())
            self._saver(BestCheckpoint).scores_start = True
        if rank_zero_only.rank:  # type: ignore[attr-defined]  # (Lightning sets it)
            return
        self.locks.enter_context(self.run_folder.lock())
        self.run_folder.remove_unfinished()
        if not self._goes_on():
            self.run_folder.check_new()
        self._print_start(f"{self.former}Files: {self.run_folder.root}. Ctrl-C stops after a step, to go on later.\n")
        if resumed is None and isinstance(self.datamodule.data_source, FolderSource):
            sys.stderr.write(contradictions_warning(self.datamodule.data_source))

    def before_validate(self) -> None:
        self.model.tested_members = self.config_init[self.subcommand].get("members")
        if self.matched is None:
            self._load_checkpoint()
        else:
            self.model.emulator.load_state_dict(self.matched.model.emulator.state_dict())
            self.config_init[self.subcommand]["ckpt_path"] = None  # its weights are of another form
        if not rank_zero_only.rank:  # type: ignore[attr-defined]  # (Lightning sets it)
            self._print_start()

    before_test = before_predict = before_validate

    def _print_start(self, more: str = "") -> None:
        device, emulator = self.trainer.strategy.root_device, self.model.emulator
        hardware = self.threads.describe(self.trainer) if device.type == "cpu" else device_name(device)
        weights = sum(parameter.numel() for parameter in emulator.parameters())
        precision = "bfloat16 is emulated on this processor; training in float32.\n" if self.bfloat16_replaced else ""
        sys.stdout.write(
            f"{self.note}{self.matched or ''}Data: {self.datamodule.description}. Model:"
            f" {type(emulator.recipe.processor).__name__}, {weights:,} parameters, on {hardware}.\n{precision}{more}"
        )
        sys.stdout.flush()

    def fit(self, **options: Any) -> None:
        """Train, then test the best weights; an interruption, or the end of another rank, says how to go on."""
        rank = rank_zero_only.rank or 0  # type: ignore[attr-defined]  # (Lightning sets it)
        watch = RankWatch(rank, lambda: getattr(self.trainer.strategy.launcher, "procs", []), self._how_to_go_on)
        try:
            self.trainer.fit(**options)
            self._test_best_weights()
            if self.trainer.is_global_zero:
                data = self.config[self.subcommand]["data"]
                source = self.datamodule.data_source
                path = source.folder if data["source"] == "hub" else data["path"]
                facts = source.options.arguments if isinstance(source, FolderSource) else []
                sys.stdout.write(self.run_folder.next_commands(str(path or data["name"] or "DATA"), facts))
        except SystemExit as ended:
            if not isinstance(ended.__context__, KeyboardInterrupt):
                raise
            if self.trainer.is_global_zero:
                raise KeyboardInterrupt(self._how_to_go_on()) from None
            raise SystemExit(130) from None
        except RuntimeError as error:
            if not is_lost_connection(error):
                raise
            if line := watch.line():
                raise NmpmError(line) from None
            raise SystemExit(1) from None
        finally:
            watch.stop()

    def _how_to_go_on(self) -> str:
        if not self.run_folder.checkpoints["last"].is_file():
            return "interrupted before the first step. The same command starts again; simulated trajectories are kept."
        step = self._saver(LastCheckpoint).saved_step
        stopped = f"stopped at step {step}" if step else "interrupted"
        config = read_config(self.run_folder.root / CONFIG)
        trust = [OPTION] if foreign_names(config) else []
        words = ["nmpm", "fit", "--resume", str(self.run_folder.root), *trust]
        return f"{stopped}. Go on with: {shlex.join(words)}"

    def _test_best_weights(self) -> None:
        """Validate the last weights if no validation has, then test the best ones; without validations, the last."""
        callbacks = self.trainer.callbacks  # type: ignore[attr-defined]  # (Lightning sets it)
        callbacks[:] = [one for one in callbacks if not isinstance(one, BatchSizeFinder)]  # (it would act here, too)
        best = self._saver(BestCheckpoint)
        if best.monitor and self.trainer.limit_val_batches and best.scored_step < self.trainer.global_step:
            self.trainer.validate(self.model, datamodule=self.datamodule, verbose=False)
            best.score(self.trainer)
        # Not by `ckpt_path`, from which a WeightAveraging callback that has just trained takes the raw weights.
        path = Path(best.best_model_path or self.run_folder.checkpoints["last"])
        if path.is_file():
            content = read_checkpoint(path)
            self.model.load_state_dict(content["state_dict"])
            if best.best_model_path and best.start_score is not None:
                self.report.progress = best.describe_progress(content["global_step"], self.trainer.global_step)
        untested = "" if self.trainer.limit_test_batches else "--trainer.limit_test_batches is 0."
        if not self.datamodule.has_test:
            untested = f"{self.datamodule.data_source.description} has no test split."
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
    value = _with_home(value)
    if isinstance(value, dict) and isinstance(model := value.get("model"), dict):
        value["model"] = with_loss(model)
    return value


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
    try:
        with quiet_lightning(), _treat_sigterm_like_sigint(), ExitStack() as locks:
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
            part.write_text(self.parser.dump(config, skip_unset=False), encoding="utf-8")
