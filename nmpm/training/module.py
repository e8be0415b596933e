"""The LightningModule: unrolled training, full rollouts for validation and test, beside the trivial predictors."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_info
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor

from nmpm._support.collectives import global_mean
from nmpm._support.digests import weights_digest
from nmpm._support.plain_data import class_path
from nmpm.emulator import Emulator, EmulatorRecipe, Rollout, predict_rollout
from nmpm.emulator.calibration import calibrate
from nmpm.emulator.fields import warn_of_ignored
from nmpm.emulator.model import compile_network
from nmpm.emulator.recipe import FORMAT, check_format
from nmpm.emulator.rollouts import recomputed
from nmpm.errors import ConfigError
from nmpm.evaluation.comparison import Comparison
from nmpm.metrics import MSE, RolloutMetric, overall_error
from nmpm.particles import Window
from nmpm.scene import Scene
from nmpm.training.augmentation import Augmentation
from nmpm.training.budget import Clock, check_end, total_steps
from nmpm.training.compatibility import (
    adopt_optimizer_arguments,
    changed_arguments,
    check_horizon,
    check_same_optimizer,
    check_same_recipe,
    check_same_scene,
)
from nmpm.training.losses import FieldError, TrainingError
from nmpm.training.optimization import OptimizerCallable, adam, build_optimizer, with_learning_rate
from nmpm.training.parts import MOST_PARTS, mean_over_parts, on_threads, split_rows
from nmpm.training.precision import warn_of_slow_precision
from nmpm.training.schedules import Schedule
from nmpm.training.trainer_checks import (
    check_evaluating_trainer,
    check_new,
    check_resuming_trainer,
    check_trainer,
)
from nmpm.training.unrolling import Discount, direct, unroll_training

CALIBRATION_BATCHES = 4

OVERALL = "overall"
"""Name of the validation error by which the best checkpoint is chosen, see `overall_error`."""


class EmulatorModule(LightningModule):
    """Trains an emulator on windows; validates and tests it by full rollouts.

    Args:
        scene: The facts of the scenes; from the command line it comes from the data.
        unroll: K, calls that a training step backpropagates through; the training horizon is m K frames.
        unroll_growth: Share of the training, in [0, 1], over which the calls grow from 1 to K: early steps are cheap.
        gradient_discount: In [0, 1], factor on gradients from each bundle to the one before. At 1, plain
            backpropagation through time, much of them is noise; at 0, trainings diverge.
        optimizer: Makes the optimizer from the parameters.
        schedule: Factor on the learning rate over the training.
        density_weight: Weight of the density error at each bundle's last frame, beside the position error; 0 for none.
        field_weight: Weight of the error of evolving fields, such as a temperature, in units of their spread; 0 for
            none.
        error_power: Power, in (0, 1], to which the position error, in cells², of each window and bundle is raised
            before the mean, as are those of fields. At 0.5, calm windows and early bundles weigh as much as splashes;
            at 1, mean squares.
        position_noise: Standard deviation of the noise on a training window's initial positions, in domain lengths.
        mirror: Axes along which half of the training windows are mirrored; those without gravity.
        jitter: Cells, up to half of one, by which the grid is moved at most in each training step, within the scene's
            wall layer: where cells lie is chance, on which little should depend.
        metrics: Errors that validations and tests report, see `nmpm.metrics`.
        recompute: Whether gradients recompute each bundle instead of keeping its activations: the memory of one bundle
            instead of K, for the time of one more forward pass.
        compile: Whether to compile the network by torch.compile, where that works. It takes half a minute or more at
            the start; on a CPU it gains next to nothing.
        seed: Of the noise.
        recipe: The emulator's form: the further arguments of `EmulatorRecipe`.

    Attributes:
        parts: In how many parts a batch is computed on a CPU; None for as many as torch has threads, at most 4. Other
            numbers change results by rounding.
        threads: How many threads compute them; None for one each. Changes no result.
    """

    def __init__(
        self,
        scene: Scene,
        unroll: int = 2,
        unroll_growth: float = 0.0,
        gradient_discount: float = 0.5,
        optimizer: OptimizerCallable = adam,
        schedule: Schedule = Schedule(),  # noqa: B008 (frozen)
        density_weight: float = 4.0,
        field_weight: float = 1.0,
        error_power: float = 0.5,
        position_noise: float = 0.0,
        mirror: Sequence[int] = (),
        jitter: float = 0.0,
        metrics: Sequence[RolloutMetric] | None = None,
        recompute: bool = False,
        compile: bool = False,  # noqa: A002 (torch's word)
        seed: int = 0,
        **recipe: Any,
    ) -> None:
        super().__init__()
        self.emulator = EmulatorRecipe(scene, **recipe).build()
        scene = self.emulator.scene
        if not 0 <= unroll_growth <= 1:
            raise ConfigError(f"model.unroll_growth = {unroll_growth} is a share of the training, in [0, 1].")
        self.unroll, self.unroll_growth = unroll, unroll_growth
        self.discount = Discount(gradient_discount)
        self.make_optimizer = optimizer
        self.schedule = schedule if isinstance(schedule, Schedule) else Schedule(**schedule)
        self.error = TrainingError(density_weight, error_power)
        self.field_error = FieldError(field_weight, error_power)
        self.augmentation = Augmentation(tuple(mirror), jitter, position_noise)
        self.augmentation.check(scene, self.emulator.grid)
        self.recompute, self.compiled = recompute, compile
        self.seed = seed
        self.parts: int | None = None
        self.threads: int | None = None
        plain = self.emulator.recipe.to_dict()
        del plain["format"]  # (of the checkpoint, see on_save_checkpoint)
        own = {
            "unroll": unroll,
            "unroll_growth": unroll_growth,
            "gradient_discount": gradient_discount,
            "schedule": dataclasses.asdict(self.schedule),
            "density_weight": density_weight,
            "field_weight": field_weight,
            "error_power": error_power,
            "position_noise": position_noise,
            "mirror": list(mirror),
            "jitter": jitter,
            "recompute": recompute,
            "compile": compile,
            "seed": seed,
        }
        self.save_hyperparameters(plain | own, logger=False)
        chosen = [MSE()] if metrics is None else list(metrics)
        self.valid_errors = Comparison(scene, [metric for metric in chosen if metric.cheap])
        self.test_errors = Comparison(scene, chosen)
        self._clock = Clock()
        self._steps_before = 0  # of the trainer, in other trainings
        self._configured = self._rate_changed = False

    @classmethod
    def of(cls, emulator: Emulator, **options: Any) -> EmulatorModule:
        """A module that trains a copy of an emulator: `EmulatorModule.of(Zoo.load("goop").emulator, unroll=4)`.

        The copy starts with the emulator's weights and normalisation statistics; the original stays as it is.

        Args:
            emulator: Trained before; of the zoo, or `load_module(path).emulator`.
            options: Arguments of the constructor, such as `unroll` and `optimizer`; those of the recipe replace the
                emulator's own, for example its `constraints`.
        """
        recipe = {field.name: getattr(emulator.recipe, field.name) for field in dataclasses.fields(emulator.recipe)}
        module = cls(**(recipe | options))
        module.emulator.load_state_dict(emulator.state_dict())
        return module

    @property
    def lr(self) -> float:
        """The optimizer's learning rate before the schedule, which Lightning's learning-rate finder sets."""
        rate: float = build_optimizer(self.make_optimizer, self.emulator.parameters()).param_groups[0]["lr"]
        return rate

    @lr.setter
    def lr(self, rate: float) -> None:
        self.make_optimizer = with_learning_rate(self.make_optimizer, rate)
        self._rate_changed = True

    def configure_callbacks(self) -> Sequence[Callback] | Callback:
        """No further callbacks; Lightning asks for them before it prepares data, the moment to check the trainer.

        Raises:
            ConfigError: naming an option of the trainer that does not work, and what to do instead.
        """
        fitting = self.trainer.state.fn == TrainerFn.FITTING
        if fitting:
            check_trainer(self.trainer, self)
        else:
            check_evaluating_trainer(self.trainer)
        self._steps_before, self._configured = self.trainer.global_step, False
        return super().configure_callbacks()

    def setup(self, stage: str) -> None:
        """Make sure that the data are of the model's scene, and training windows as long as its horizon.

        Raises:
            ConfigError: naming the facts in which they differ, or both horizons.

        Warns:
            UserWarning: naming the fields that the model was trained without.
        """
        data = getattr(self.trainer, "datamodule", None)
        scene, horizon = getattr(data, "scene", None), getattr(data, "horizon", None)
        if isinstance(scene, Scene):
            check_same_scene(self.emulator.scene, scene)
            warn_of_ignored(self.emulator.scene, scene.fields)
        if stage == TrainerFn.FITTING and isinstance(horizon, int):
            check_horizon(self.emulator.frames, self.unroll, horizon)

    def on_fit_start(self) -> None:
        """Compile the network, once the strategy has moved it to the device."""
        if self._rate_changed:  # by the learning-rate finder, after the optimizer was made
            self.trainer.strategy.setup_optimizers(self.trainer)
        if self.compiled:
            example = self.emulator.input_mean.expand(1, -1, *self.emulator.grid.shape)
            compile_network(self.emulator.processor, example)

    def on_train_start(self) -> None:
        """Warn of a precision that the processor has no instructions for."""
        warn_of_slow_precision(self.trainer)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """State the format, the digest of the weights, and which optimizer the stored state belongs to."""
        checkpoint["nmpm_format"] = FORMAT
        checkpoint["nmpm_digest"] = weights_digest(checkpoint["state_dict"])
        if self.trainer.optimizers:
            checkpoint["nmpm_optimizer"] = class_path(type(self.trainer.optimizers[0]))

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Compare the checkpoint with this model, and with its optimizer if a training goes on.

        A training goes on with this model's arguments; those that the checkpoint has otherwise are logged.

        Raises:
            ConfigError: if a newer version wrote it, a part differs, or a callback of the trainer cannot go on.
        """
        check_format(checkpoint.get("nmpm_format", 0), "The checkpoint")
        check_same_recipe(checkpoint["hyper_parameters"], self.emulator.recipe)
        if self._trainer is not None:  # Lightning does so after loading the weights, which would be rounded
            self._trainer.precision_plugin.convert_module(self)
        if self._trainer is not None and self._trainer.state.fn == TrainerFn.FITTING:
            if not self._configured:  # (finders load their own checkpoint later)
                check_resuming_trainer(self._trainer)
                self._steps_before = 0
            changed = self.adopt_arguments(checkpoint)
            if changed:
                step = checkpoint.get("global_step")
                rank_zero_info(f"Going on from step {step} with changed arguments: {'; '.join(changed)}.")

    def adopt_arguments(self, checkpoint: Mapping[str, Any]) -> list[str]:
        """Make a training go on from a checkpoint with this model's arguments, those of its optimizer among them.

        Args:
            checkpoint: Changed in place.

        Returns:
            What differs, such as "model.optimizer.lr = 0.001 (was 0.003)".

        Raises:
            ConfigError: if its optimizer state is of another optimizer.
        """
        optimizer = build_optimizer(self.make_optimizer, self.emulator.parameters())
        check_same_optimizer(checkpoint, optimizer)
        changed = changed_arguments(checkpoint["hyper_parameters"], dict(self.hparams))
        return changed + adopt_optimizer_arguments(checkpoint, optimizer)

    def on_train_batch_start(self, batch: Window, batch_idx: int) -> None:  # noqa: ARG002
        """Seed the batch's random numbers by its index, so that a resumed run repeats them.

        All ranks use the same seed: each takes its own rows of the numbers drawn for all. The index is the number of
        finished batches: Lightning's `total_batch_idx` also counts one that was interrupted, which is repeated.
        """
        finished = self.trainer.fit_loop.epoch_loop.batch_progress.total.processed  # type: ignore[attr-defined]  # (of batches)
        entropy = (self.seed, 0, finished)
        torch.manual_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))

    def training_step(self, batch: Window, batch_idx: int) -> Tensor:  # noqa: ARG002
        """This rank's part of the mean error over the particles of all ranks, which is logged.

        Over several batches (`accumulate_grad_batches`) Lightning takes the plain mean, so that a particle weighs a
        little more in a batch with fewer particles.
        """
        batch = self.augmentation.mirrored(batch, self.emulator.scene)
        particles, emulator = self.augmentation.start(batch), self.augmentation.jittered(self.emulator)
        count, call = self.bundles(self._progress()), recomputed if self.recompute else direct

        def mean_error(rows: slice) -> Tensor:
            bundles = unroll_training(emulator, particles.scenes(rows), count, call, self.discount)
            predicted = Rollout.join([Rollout(bundle.position, bundle.fields) for bundle in bundles])
            return self._error(predicted, batch.scenes(rows))

        rows = self.rows(batch)
        if len(rows) == 1:
            error = mean_error(rows[0])
        else:
            error = mean_over_parts(mean_error, batch.mask, rows, self.parameters(), self.threads or len(rows))
        loss, logged = global_mean(error, batch.mask.sum())
        self.log("train/loss", logged)
        return loss

    def _error(self, predicted: Rollout, batch: Window) -> Tensor:
        """The error of K m predicted frames, in float32 whatever autocast says."""
        emulator = self.emulator
        with torch.autocast(predicted.position.device.type, enabled=False):
            error = self.error(predicted.position, batch, emulator.scene, emulator.grid, emulator.frames)
            spread = emulator.field_scales.spread
            return error + self.field_error(predicted.fields, batch, spread, emulator.frames)

    def validation_step(self, batch: Window, batch_idx: int) -> None:  # noqa: ARG002
        predicted = self._predict(batch)
        self.valid_errors.update(batch, predicted.position, predicted.fields)

    def test_step(self, batch: Window, batch_idx: int) -> Tensor:  # noqa: ARG002
        with torch.autocast(self.device.type, enabled=False):  # in the precision that trained models are used in
            predicted = self._predict(batch)
        self.test_errors.update(batch, predicted.position, predicted.fields)
        return predicted.position

    def predict_step(self, batch: Window, batch_idx: int) -> Tensor | Rollout:  # noqa: ARG002
        """(B, T - 2, N, D) predicted positions; with the fields where the scene has any that evolve."""
        predicted = self._predict(batch)
        return predicted if predicted.fields else predicted.position

    def _predict(self, batch: Window) -> Rollout:
        start, frames, rows = batch.initial, batch.target.shape[1], self.rows(batch)
        if len(rows) == 1:
            return predict_rollout(self.emulator, start, frames)
        parts = on_threads(
            lambda part: predict_rollout(self.emulator, start.scenes(part), frames), rows, self.threads or len(rows)
        )
        return Rollout.stack(parts)

    def rows(self, batch: Window) -> list[slice]:
        """The rows of the parts of a batch that a thread each computes, on a CPU.

        All in one where torch compiles for a shape, or noise is drawn for all windows together.
        """
        compiled = self.compiled or self.emulator.shapes_are_compiled
        whole = self.device.type != "cpu" or compiled or self.emulator.recipe.grid_noise > 0
        return split_rows(len(batch.frames), 1 if whole else self.parts or min(torch.get_num_threads(), MOST_PARTS))

    def on_validation_epoch_start(self) -> None:
        self.valid_errors.reset()

    def on_test_epoch_start(self) -> None:
        self.test_errors.reset()

    def on_validation_epoch_end(self) -> None:
        errors = self.valid_errors.compute()
        overall = overall_error(errors, self.emulator.frames * self.unroll)
        self.log_dict({f"valid/{name}": value for name, value in (errors | {OVERALL: overall}).items()})

    def on_test_epoch_end(self) -> None:
        self.log_dict({f"test/{name}": value for name, value in self.test_errors.compute().items()})

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """The optimizer, and the schedule of its learning rate. A new emulator is calibrated first.

        Here and not in `on_fit_start`, as Lightning's finders take their steps before that.

        Raises:
            ConfigError: if the learning rate is not a positive number, the training has no end, or the trainer has
                been used for another one.
        """
        check_new(self._steps_before)
        check_end(self.trainer)
        if not self.emulator.calibrated:
            self.trainer.fit_loop.setup_data()
            loader: Iterable[Window] = self.trainer.train_dataloader  # type: ignore[assignment]  # (loaded)
            calibrate(self.emulator, list(islice(loader, CALIBRATION_BATCHES)))
        self._configured, self._rate_changed = True, False
        optimizer = build_optimizer(self.make_optimizer, self.emulator.parameters())
        total = total_steps(self.trainer)
        scheduler = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: self.schedule.factor(step, total, self._clock.share(self.trainer, step))
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def bundles(self, progress: float) -> int:
        """Number of bundles that a step unrolls once this share of the training is over."""
        if progress >= self.unroll_growth:
            return self.unroll
        return 1 + int((self.unroll - 1) * progress / self.unroll_growth)

    def _progress(self) -> float:
        """Share of the training that is over, by steps or by the clock, whichever is further."""
        if not self.unroll_growth:
            return 1.0
        step = self.global_step
        return max(step / total_steps(self.trainer), self._clock.share(self.trainer, step))
