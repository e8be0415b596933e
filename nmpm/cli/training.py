"""`nmpm fit | validate | test | predict`: LightningCLI with the data's scene flowing into the model."""

from __future__ import annotations

import operator
import sys
from pathlib import Path
from typing import Any

from jsonargparse import set_parsing_settings
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from nmpm._support.plugins import load_plugins
from nmpm._support.shipped import find_config
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.errors import ConfigError
from nmpm.training.callbacks.divergence import DivergenceGuard
from nmpm.training.callbacks.prediction_writer import PredictionWriter
from nmpm.training.callbacks.report import Report
from nmpm.training.checkpoints import read_checkpoint
from nmpm.training.module import EmulatorModule

BEST = {"filename": "best", "monitor": "valid/mse", "enable_version_counter": False}
# A checkpoint of its own to resume from: ModelCheckpoint's `save_last` leaves the last one as it was whenever the best
# does not change.
LAST = {"filename": "last", "every_n_train_steps": 100, "enable_version_counter": False}


class EmulatorCLI(LightningCLI):
    """Links what the model needs from the data and the other way round, and ends a fit with a test."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
        parser.set_defaults({f"checkpoint.{key}": value for key, value in BEST.items()})
        parser.add_lightning_class_args(ModelCheckpoint, "resume")
        parser.set_defaults({f"resume.{key}": value for key, value in LAST.items()})
        parser.link_arguments("data.scene", "model.scene", apply_on="instantiate")
        parser.link_arguments(("model.frames", "model.unroll"), "data.horizon", compute_fn=operator.mul)

    def before_instantiate_classes(self) -> None:
        """Read checkpoints as tensors and plain data, executing nothing, and keep a run's files in one folder."""
        config = self.config[self.subcommand]
        config["weights_only"] = True
        config["trainer"]["default_root_dir"] = config["trainer"]["default_root_dir"] or "runs/default"
        for saver in ("checkpoint", "resume"):
            folder = Path(config["trainer"]["default_root_dir"]) / "checkpoints"
            config[saver]["dirpath"] = config[saver]["dirpath"] or str(folder)

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
        kwargs["callbacks"] = [*callbacks, DivergenceGuard(), Report(), PredictionWriter()]
        return super().instantiate_trainer(**kwargs)

    def _parse_ckpt_path(self) -> None:
        """The configuration is the truth: a checkpoint's stored hyperparameters do not silently override it."""

    def before_fit(self) -> None:
        """Refuse to write a new run over an old one, or to go on from a damaged checkpoint.

        Raises:
            ConfigError: if the folder holds a run and no checkpoint is to be continued.
            DataError: if the checkpoint cannot be read.
        """
        self._read_checkpoint()
        folder = Path(self.trainer.default_root_dir)
        if not self.config_init[self.subcommand].get("ckpt_path") and (folder / "checkpoints" / "last.ckpt").exists():
            raise ConfigError(
                f"{folder} already holds a run. Go on with it by adding --ckpt_path last, or choose another folder "
                "with --trainer.default_root_dir."
            )

    def before_validate(self) -> None:
        self._read_checkpoint()

    def before_test(self) -> None:
        self._read_checkpoint()

    def before_predict(self) -> None:
        self._read_checkpoint()

    def _read_checkpoint(self) -> None:
        given = self.config_init[self.subcommand].get("ckpt_path")
        if not given:
            return
        names = {
            name: Path(self.trainer.default_root_dir) / "checkpoints" / f"{name}.ckpt" for name in ("last", "best")
        }
        path = names.get(str(given), Path(given))
        if given not in names or path.is_file():  # (Lightning says where it looked for those)
            read_checkpoint(path)

    def after_fit(self) -> None:
        """Judge the last weights too, if no validation has, and test the best ones, once."""
        checkpoint = self.trainer.checkpoint_callback
        if isinstance(checkpoint, ModelCheckpoint) and checkpoint.monitor:
            if self.model.validated_step < self.trainer.global_step:
                self._judge_last_weights(checkpoint)
            best = checkpoint.best_model_path
        else:
            best = ""
        self.trainer.test(
            self.model, datamodule=self.datamodule, ckpt_path=best or None, verbose=False, weights_only=True
        )

    def _judge_last_weights(self, checkpoint: ModelCheckpoint) -> None:
        self.trainer.validate(self.model, datamodule=self.datamodule, verbose=False)
        score = self.trainer.callback_metrics[str(checkpoint.monitor)]
        if checkpoint.check_monitor_top_k(self.trainer, score):
            path = Path(str(checkpoint.dirpath)) / f"{checkpoint.filename}{checkpoint.FILE_EXTENSION}"
            self.trainer.save_checkpoint(path)
            checkpoint.best_model_path, checkpoint.best_model_score = str(path), score


def run(words: list[str]) -> None:
    """Run a training command, e.g. ["fit", "--config", "goop.yaml"]."""
    load_plugins()
    set_parsing_settings(omegaconf_absolute_to_relative_paths=True)
    # Not as `args`: Lightning starts further processes by the command line, and warns where the two differ.
    sys.argv = [sys.argv[0], *_with_shipped_configs(words)]
    EmulatorCLI(
        EmulatorModule,
        TrajectoryDataModule,
        seed_everything_default=0,
        parser_kwargs={"parser_mode": "omegaconf+"},
        save_config_kwargs={"overwrite": True},
    )


def _with_shipped_configs(words: list[str]) -> list[str]:
    """Replace the name behind each --config by the file that it means."""
    found = list(words)
    for index, word in enumerate(words):
        if word in ("--config", "-c") and index + 1 < len(words):
            found[index + 1] = str(find_config(words[index + 1]))
        elif word.startswith("--config="):
            found[index] = f"--config={find_config(word.removeprefix('--config='))}"
    return found
