"""LightningCLI with the data's scene flowing into the model, a run's files in one folder, and interruptions."""

from __future__ import annotations

import operator
import shlex
import sys
from pathlib import Path
from typing import Any, TypeVar

from jsonargparse.typing import PositiveInt
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import BatchSizeFinder, LearningRateMonitor, ProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.strategies.launchers import _MultiProcessingLauncher
from lightning.pytorch.utilities import rank_zero_only

from nmpm._support.collectives import RankWatch, is_lost_connection
from nmpm._support.devices import device_name, find_device
from nmpm._support.threads import stated_threads
from nmpm.cli.console import BriefParser, explain, is_of_other_packages
from nmpm.cli.early_checks import UsageError, read_config
from nmpm.cli.matched_run import MatchedRun, add_arguments, stored_scene
from nmpm.cli.options import check_folder
from nmpm.cli.run_folder import CHECKPOINTS, CONFIG, SAVERS, RunFolder, next_folder
from nmpm.cli.trust import OPTION, foreign_names
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.inspection.quick import contradictions_warning, stated_options
from nmpm.data.loading.sources import FolderSource
from nmpm.errors import ConfigError, NmpmError
from nmpm.scene import Scene
from nmpm.training.budget import check_endless_batches
from nmpm.training.callbacks.divergence import DivergenceGuard
from nmpm.training.callbacks.forecast import Forecast
from nmpm.training.callbacks.outputs import PredictionWriter, ReportWriter
from nmpm.training.callbacks.progress import Progress
from nmpm.training.callbacks.savers import DEFAULTS, BestCheckpoint, LastCheckpoint
from nmpm.training.callbacks.threads import THREADS, Threads
from nmpm.training.checkpoints import AtomicCheckpointIO, read_checkpoint
from nmpm.training.module import EmulatorModule
from nmpm.training.optimization import check_learning_rate
from nmpm.training.preflight import check_disk, check_memory, fitting_precision

T = TypeVar("T")


class EmulatorCLI(LightningCLI):
    """Runs fit, validate, test or predict as a configuration says; a fit ends with a test.

    The descriptor of the run folder's lock is appended to `locks`; the `note` is printed at the start.
    """

    def __init__(self, command: str, note: str, locks: list[int], **options: Any) -> None:
        self.command, self.note, self.locks = command, note, locks
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
        parser.add_argument("--threads", type=PositiveInt | None, default=None, help=THREADS)
        add_arguments(parser, self.command)
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
        self.matched = MatchedRun.of(config, None if self.subcommand == "fit" else self.checkpoint_path())
        if self.matched is not None:
            self.matched.complete(config)

    def instantiate_classes(self) -> None:
        """Make data, model and trainer; ConfigError says what Lightning, or a package of loggers, does not take."""
        try:
            super().instantiate_classes()
        except Exception as error:  # (other packages document none)
            if isinstance(error, NmpmError | UsageError) or not is_of_other_packages(error):
                raise
            raise ConfigError(explain(str(error), ())) from error

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """The trainer, with CSV and TensorBoard logs in the run's folder unless the configuration says otherwise."""
        config = self.config_init[self.subcommand]["trainer"]
        configured = config.get("callbacks") or []
        # What is given to Lightning's method replaces what is configured.
        callbacks = [*(configured if isinstance(configured, list) else [configured]), *kwargs.get("callbacks", [])]
        if config.get("logger") in (None, True):
            table = CSVLogger(config["default_root_dir"], name="logs")
            kwargs["logger"] = [table, TensorBoardLogger(table.root_dir, name="", version=table.version)]
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
        check_memory(self.trainer, self.model, self.datamodule.batch_size)
        resumed = self._load_checkpoint()
        if resumed is not None:
            self.model.adopt_arguments(resumed)  # refuses another optimizer before data are simulated
        elif self.matched is not None:
            self.model.emulator.load_state_dict(self.matched.model.emulator.state_dict())
            self._saver(BestCheckpoint).scores_start = True
        if rank_zero_only.rank:  # type: ignore[attr-defined]  # (Lightning sets it)
            return
        self.locks.append(self.run_folder.lock())
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
                facts = stated_options(source) if isinstance(source, FolderSource) else []
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
