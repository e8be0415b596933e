"""LightningCLI with the data's scene flowing into the model, and a run's files in one folder."""

from __future__ import annotations

import operator
from pathlib import Path
from typing import Any

from jsonargparse.typing import PositiveInt
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint, ProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.strategies.launchers import _MultiProcessingLauncher

from nmpm._support.atomic import atomic_write
from nmpm._support.devices import find_device
from nmpm._support.threads import stated_threads
from nmpm.cli.console import BriefParser, explain, is_of_other_packages
from nmpm.cli.early_checks import UsageError
from nmpm.cli.options import check_folder
from nmpm.cli.run_folder import CHECKPOINTS, CONFIG, SAVERS, RunFolder
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.errors import ConfigError, NmpmError
from nmpm.scene import Scene
from nmpm.training.callbacks.divergence import DivergenceGuard
from nmpm.training.callbacks.forecast import Forecast
from nmpm.training.callbacks.outputs import PredictionWriter, ReportWriter
from nmpm.training.callbacks.progress import Progress
from nmpm.training.callbacks.savers import BestCheckpoint, LastCheckpoint
from nmpm.training.callbacks.threads import Threads
from nmpm.training.checkpoints import AtomicCheckpointIO, read_checkpoint
from nmpm.training.module import EmulatorModule
from nmpm.training.optimization import check_learning_rate
from nmpm.training.preflight import OVERALL, fitting_precision

# Two savers, as ModelCheckpoint's `save_last` leaves the last checkpoint as it was whenever the best does not change.
SAVER_DEFAULTS: dict[str, tuple[type[ModelCheckpoint], dict[str, Any]]] = {
    "best": (BestCheckpoint, {"monitor": f"valid/{OVERALL}"}),
    "last": (LastCheckpoint, {"every_n_train_steps": 100}),
}
THREADS = (
    "Of a CPU, which compute parts of a batch (default: OMP_NUM_THREADS; else the faster of one and all that may be"
    " used, as measured). Another number changes results by rounding."
)
START_FROM = "Model whose weights a new training starts with: a zoo name, a run or a checkpoint, of the same parts."


class ConfiguredCLI(LightningCLI):
    """Makes data, model and trainer of a configuration; links what the model needs from the data and vice versa.

    Args:
        command: fit, validate, test or predict.
        options: Of LightningCLI.
    """

    def __init__(self, command: str, **options: Any) -> None:
        self.command = command
        self.bfloat16_replaced = False
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
        for name, (kind, defaults) in SAVER_DEFAULTS.items():
            parser.add_lightning_class_args(kind, SAVERS[name])
            given = defaults | {"filename": name, "enable_version_counter": False}
            parser.set_defaults({f"{SAVERS[name]}.{key}": value for key, value in given.items()})
        parser.add_argument("--threads", type=PositiveInt | None, default=None, help=THREADS)
        if self.command == "fit":
            parser.add_argument("--start_from", type=str | None, default=None, help=START_FROM)
        parser.link_arguments("data.scene", "model.scene", apply_on="instantiate", compute_fn=self._model_scene)
        parser.link_arguments(("model.frames", "model.unroll"), "data.horizon", compute_fn=operator.mul)

    def _model_scene(self, scene: Scene) -> Scene:
        """The data's scene, with fields of the checkpoint under evaluation that the data lack."""
        if self.subcommand == "fit":
            return scene
        try:
            path = self.checkpoint_path()
            stored = read_checkpoint(path).get("hyper_parameters", {}).get("scene") if path else None
        except NmpmError:  # is raised again when the checkpoint is loaded; here the parser would wrap it
            return scene
        return scene.with_fields_of(Scene.from_dict(stored)) if isinstance(stored, dict) else scene

    def _parse_ckpt_path(self) -> None:
        """The configuration is the truth: a checkpoint's stored hyperparameters do not silently override it."""

    # Data, model and trainer

    def before_instantiate_classes(self) -> None:
        """Check and complete the configuration; checkpoints are read as tensors and plain data.

        Raises:
            ConfigError: if an untrained model would be evaluated, or an option cannot be.
        """
        config = self.config[self.subcommand]
        trainer, optimizer = config["trainer"], config["model"].get("optimizer")
        config["weights_only"] = True
        trainer["default_root_dir"] = trainer["default_root_dir"] or "runs/default"
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

    def instantiate_classes(self) -> None:
        """Make data, model and trainer.

        Raises:
            ConfigError: saying what Lightning, or a package for loggers and the like, does not take.
        """
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


class RunConfig(SaveConfigCallback):
    """Writes a training's configuration into the run's folder, such that `nmpm test RUN` works from anywhere."""

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:  # noqa: ARG002
        if stage != "fit":
            return
        config, root = self.config.clone(), Path(self.config["trainer"]["default_root_dir"])
        config["ckpt_path"] = None
        config.pop("start_from", None)  # unknown to other commands, and of the start alone
        for saver in SAVERS.values():
            folder = Path(config[saver]["dirpath"])
            config[saver]["dirpath"] = None if folder == root / CHECKPOINTS else str(folder.absolute())
        if config["data"]["path"]:
            config["data"]["path"] = str(Path(config["data"]["path"]).absolute())
        with atomic_write(root / CONFIG) as part:
            part.write_text(self.parser.dump(config, skip_none=False), encoding="utf-8")
