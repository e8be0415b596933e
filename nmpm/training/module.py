"""The LightningModule: unrolled training, full rollouts for validation and test, beside the trivial predictors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_info
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor

from nmpm._support.collectives import global_mean
from nmpm._support.former import LOSS_OPTIONS
from nmpm._support.messages import one_line
from nmpm._support.plain_data import class_path, from_spec, to_spec
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator import Emulator, EmulatorRecipe, Prescribed, Rollout, RolloutOptions, predict_rollout
from nmpm.emulator.adaptation import adapted, with_members
from nmpm.emulator.calibration import calibrate, calibrate_unread, unread_inputs
from nmpm.emulator.digests import weights_digest
from nmpm.emulator.fields import warn_of_ignored
from nmpm.emulator.noise import training_noise
from nmpm.emulator.recipe import FORMAT, check_format
from nmpm.emulator.rollouts import recomputed
from nmpm.errors import ConfigError, DataError, NmpmError
from nmpm.evaluation.comparison import Comparison
from nmpm.evaluation.ensembles import EnsembleTest
from nmpm.metrics import MSE, RolloutMetric, overall_error
from nmpm.particles import Particles, Window
from nmpm.scene import Reading, Scene
from nmpm.training import checkpoints, preflight
from nmpm.training.augmentation import check_jitter, check_mirrors, mirror_half, noisy_start, with_jitter
from nmpm.training.backpropagation import (
    MOST_PARTS,
    CastNetworks,
    mean_over_parts,
    on_threads,
    predict_window,
    split_rows,
)
from nmpm.training.budget import Clock, check_end, total_steps
from nmpm.training.losses import Loss, PositionLoss, counted
from nmpm.training.optimization import OptimizerCallable, Schedule, adam, build_optimizer, with_learning_rate
from nmpm.training.recorded_steps import MULTIPLE, RecordedSteps, can_record

CALIBRATION_BATCHES = 4
VALIDATED = 4
"""Members of each scene in validations of ensembles."""

B = TypeVar("B", Particles, Window)


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
        loss: What training reduces, see `nmpm.training.losses`.
        members: M. From 2 on, a processor that reads noise (`nmpm.processors.Stochastic`) predicts each window M times,
            and the loss scores the members together, which teaches it how uncertain it is.
        position_noise: Standard deviation of the noise on a training window's initial positions, in domain lengths.
        mirror: Axes along which half of the training windows are mirrored; those without gravity.
        jitter: Cells, up to half of one, by which the grid is moved at most in each training step, within the scene's
            wall layer: where cells lie is chance, on which little should depend.
        metrics: Errors that validations and tests report, see `nmpm.metrics`.
        recompute: Whether gradients recompute each bundle instead of keeping its activations: the memory of one bundle
            instead of K, for one more forward pass.
        compile: Whether to compile the network by torch.compile, which takes half a minute or more; no gain on a CPU.
        record: Whether to record steps as CUDA graphs, which saves launches on a GPU; no effect elsewhere.
        seed: Of the noise.
        recipe: The emulator's form: the further arguments of `EmulatorRecipe`.

    Attributes:
        parts: In how many parts a batch is computed on a CPU; None for as many as torch has threads, at most 4. Other
            numbers change results by rounding.
        threads: How many threads compute them; None for one each. Changes no result.
        reading: How the data are read for the emulator; errors count frames of the data.
        tested_members: Members of which tests measure scores, too; None for none.
        ensemble: These scores, in tests of members and in validations of ensembles.
    """

    parts: int | None = None
    threads: int | None = None
    tested_members: int | None = None
    ensemble: EnsembleTest | None = None

    def __init__(
        self,
        scene: Scene,
        unroll: int = 2,
        unroll_growth: float = 0.0,
        gradient_discount: float = 0.5,
        optimizer: OptimizerCallable = adam,
        schedule: Schedule = Schedule(),  # noqa: B008 (frozen)
        loss: Loss = PositionLoss(),  # noqa: B008
        members: int = 1,
        position_noise: float = 0.0,
        mirror: Sequence[int] = (),
        jitter: float = 0.0,
        metrics: Sequence[RolloutMetric] | None = None,
        recompute: bool = False,
        compile: bool = False,  # noqa: A002 (torch's word)
        record: bool = False,
        seed: int = 0,
        **recipe: Any,
    ) -> None:
        former = {name: recipe.pop(old) for old, name in LOSS_OPTIONS.items() if old in recipe}
        emulator = with_members(EmulatorRecipe(scene, **recipe), members).build()
        super().__init__()
        self.emulator, self.reading = emulator, Reading(emulator.scene)
        reported = [MSE()] if metrics is None else list(metrics)
        self.valid_errors = Comparison(emulator.scene, [one for one in reported if one.cheap], emulator.frames)
        self.test_errors = Comparison(emulator.scene, reported, emulator.frames)
        for name, share in (("unroll_growth", unroll_growth), ("gradient_discount", gradient_discount)):
            if not 0 <= share <= 1:
                raise ConfigError(f"model.{name} = {share} must be in [0, 1], a share.")
        self.unroll, self.unroll_growth, self.gradient_discount = unroll, unroll_growth, gradient_discount
        self.make_optimizer = optimizer
        self.schedule = schedule if isinstance(schedule, Schedule) else Schedule(**schedule)
        self.loss, self.members = from_spec(loss, Loss), members
        if former:
            self.loss = dataclasses.replace(self.loss, **former)
        self.loss.check_members(members)
        self.mirror, self.jitter, self.position_noise = tuple(mirror), jitter, position_noise
        check_mirrors(emulator.scene, self.mirror)
        check_jitter(emulator.scene, emulator.grid, jitter)
        self.recompute, self.compiled = recompute, compile
        self.record, self._recorded, self._networks = record, RecordedSteps(), CastNetworks()
        self.seed = seed
        arguments = emulator.recipe.to_dict() | {
            "unroll": unroll, "unroll_growth": unroll_growth, "gradient_discount": gradient_discount,
            "schedule": dataclasses.asdict(self.schedule), "loss": to_spec(self.loss), "members": members,
            "position_noise": position_noise, "mirror": list(mirror), "jitter": jitter, "recompute": recompute,
            "compile": compile, "record": record, "seed": seed,
        }  # fmt: skip
        del arguments["format"]  # (of the checkpoint, see on_save_checkpoint)
        self.save_hyperparameters(arguments, logger=False)
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
                emulator's, for example its `constraints`.
        """
        module = cls(**(vars(emulator.recipe) | options))
        module.emulator.load_state_dict(adapted(emulator, module.emulator.recipe).state_dict())
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
        """No further callbacks; Lightning asks for them before it prepares data, the moment to check the trainer."""
        if self.trainer.state.fn == TrainerFn.FITTING:
            preflight.check_trainer(self.trainer, self)
        else:
            preflight.check_evaluating_trainer(self.trainer)
        self._steps_before, self._configured = self.trainer.global_step, False
        return super().configure_callbacks()

    def setup(self, stage: str) -> None:
        """Raise ConfigError if data, model or metrics do not suit each other; warn of fields that are ignored."""
        data = getattr(self.trainer, "datamodule", None)
        self.reading = getattr(data, "reading", Reading(self.emulator.scene))
        for errors in (self.valid_errors, self.test_errors):
            errors.count_every(self.reading.every)
        scene, horizon = getattr(data, "scene", None), getattr(data, "horizon", None)
        if isinstance(scene, Scene):
            checkpoints.check_same_scene(self.emulator.scene, scene)
            warn_of_ignored(self.emulator.scene, scene.fields)
        frames = self.emulator.frames * self.unroll
        if stage == TrainerFn.FITTING and isinstance(horizon, int) and horizon < frames:  # (longer windows are cut)
            raise ConfigError(
                f"data.horizon = {horizon} is shorter than the {frames} frames that a training step predicts"
                f" (model.frames = {self.emulator.frames} times model.unroll = {self.unroll}): give"
                f" TrajectoryDataModule horizon={frames}, or unroll less."
            )
        if stage == TrainerFn.FITTING and isinstance(data, TrajectoryDataModule):
            preflight.check_evaluations(self.trainer, self, self.valid_errors, self.test_errors, data)

    def on_fit_start(self) -> None:
        """Compile the network, once the strategy has moved it to the device."""
        if self._rate_changed:  # by the learning-rate finder, after the optimizer was made
            self.trainer.strategy.setup_optimizers(self.trainer)
        if self.compiled:
            example = self.emulator.input_mean.expand(1, -1, *self.emulator.grid.shape)
            preflight.compile_network(self.emulator.processor, example)

    def on_train_start(self) -> None:
        preflight.warn_of_slow_precision(self.trainer)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """State the format, the digest of the weights, and which optimizer the stored state belongs to."""
        checkpoint["nmpm_format"] = FORMAT
        checkpoint["nmpm_digest"] = weights_digest(checkpoint["state_dict"])
        if self.trainer.optimizers:
            checkpoint["nmpm_optimizer"] = class_path(type(self.trainer.optimizers[0]))

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Compare the checkpoint with this model; a training goes on with this model's arguments."""
        check_format(checkpoint.get("nmpm_format"), "The checkpoint")
        checkpoints.check_same_recipe(checkpoint["hyper_parameters"], self.emulator.recipe)
        trainer = self._trainer
        if trainer is None:
            return
        trainer.precision_plugin.convert_module(self)  # Lightning does so after loading the weights, which rounds them
        if trainer.state.fn == TrainerFn.FITTING:
            if not self._configured:  # (finders load their own checkpoint later)
                preflight.check_resuming_trainer(trainer)
                self._steps_before = 0
            if changed := self.adopt_arguments(checkpoint):
                step = checkpoint.get("global_step")
                rank_zero_info(f"Going on from step {step} with changed arguments: {'; '.join(changed)}.")

    def adopt_arguments(self, checkpoint: Mapping[str, Any]) -> list[str]:
        """Let a training go on from a checkpoint, changed in place, with this model's arguments; list what differs."""
        optimizer = build_optimizer(self.make_optimizer, self.emulator.parameters())
        return checkpoints.adopt_arguments(checkpoint, dict(self.hparams), optimizer)

    def on_train_batch_start(self, batch: Window, batch_idx: int) -> None:  # noqa: ARG002
        """Seed the batch's random numbers by its index, so that a resumed run repeats them.

        All ranks use the same seed: each takes its own rows of the numbers drawn for all. The index is the number of
        finished batches: Lightning's `total_batch_idx` also counts one that was interrupted, which is repeated.
        """
        finished = self.trainer.fit_loop.epoch_loop.batch_progress.total.processed  # type: ignore[attr-defined]  # (of batches)
        torch.manual_seed(int(np.random.SeedSequence((self.seed, 0, finished)).generate_state(1)[0]))

    def training_step(self, batch: Window, batch_idx: int) -> Tensor:  # noqa: ARG002
        """This rank's part of the mean error over the particles of all ranks, which is logged.

        Over several batches (`accumulate_grad_batches`) Lightning takes the plain mean, so that a particle weighs a
        little more in a batch with fewer particles.
        """
        recorded = self.record and can_record(batch.frames.device)
        scene, grid = self.emulator.scene, self.emulator.grid
        batch = mirror_half(batch.padded(MULTIPLE) if recorded else batch, scene, grid, self.mirror)
        start, emulator = noisy_start(batch, self.position_noise), with_jitter(self.emulator, self.jitter)
        count = self.bundles(self._progress())
        counts = counted(batch, count * emulator.frames, emulator.frames)
        mean_error = partial(self._mean_error, count)
        if recorded:
            error = self._recorded.mean_error(mean_error, self.emulator, emulator, start, batch, count)
        else:
            rows, noise = self.rows(batch), training_noise(emulator, len(start.mask), self.members, count)

            def error_of(moved: Emulator, part: slice) -> Tensor:
                return mean_error(moved, start.scenes(part), batch.scenes(part), None if noise is None else noise[part])

            error = mean_over_parts(error_of, counts, rows, emulator, self._networks, self.threads or len(rows))
        loss, logged = global_mean(error, counts.sum() if counts.dim() == 2 else counts.sum() / counts.shape[1])
        self.log("train/loss", logged)
        return loss

    def _mean_error(
        self, count: int, emulator: Emulator, start: Particles, window: Window, noise: Tensor | None = None
    ) -> Tensor:
        """The mean error () of `count` bundles from the start of windows, in float32 whatever autocast says.

        The members' noise, (B, M, count, Z, *S), is drawn if it is left out.
        """
        noise = training_noise(emulator, len(start.mask), self.members, count) if noise is None else noise
        start, members = repeated(start, self.members), repeated(window, self.members)
        call = recomputed if self.recompute else Emulator.__call__  # (which keeps activations)
        predicted = predict_window(emulator, start, members, count, call, self.gradient_discount, noise)
        with torch.autocast(predicted.position.device.type, enabled=False):
            return self.loss(predicted, window, emulator)

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """The optimizer and its schedule. A new emulator is calibrated first, as finders step before `on_fit_start`."""
        if self._steps_before:
            raise ConfigError(
                f"This Trainer has taken {self._steps_before} steps already, and counts on from there: make a new"
                " Trainer for another training, or give ckpt_path to go on with this one."
            )
        check_end(self.trainer)
        if not self.emulator.calibrated or unread_inputs(self.emulator):
            self.trainer.fit_loop.setup_data()
            loader: Iterable[Window] = self.trainer.train_dataloader  # type: ignore[assignment]  # (loaded)
            set_statistics = calibrate_unread if self.emulator.calibrated else calibrate
            set_statistics(self.emulator, [check_window(batch) for batch in islice(loader, CALIBRATION_BATCHES)])
        self._configured, self._rate_changed = True, False
        optimizer = build_optimizer(self.make_optimizer, self.emulator.parameters())
        total = total_steps(self.trainer)
        scheduler = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: self.schedule.factor(step, total, self._clock.share(self.trainer, step))
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def bundles(self, progress: float) -> int:
        """Number of bundles that a step unrolls once this share of the training is over; one frame is observed."""
        if progress >= self.unroll_growth:
            return self.unroll
        least = math.ceil(self.reading.between / self.emulator.frames)
        return max(min(least, self.unroll), 1 + int((self.unroll - 1) * progress / self.unroll_growth))

    def _progress(self) -> float:
        """Share of the training that is over, by steps or by the clock; 1 where the number of bundles is constant."""
        if not self.unroll_growth:
            return 1.0
        return max(self.global_step / total_steps(self.trainer), self._clock.share(self.trainer, self.global_step))

    def on_before_batch_transfer(self, batch: object, dataloader_idx: int) -> object:  # noqa: ARG002
        return check_window(batch)

    def validation_step(self, batch: Window, batch_idx: int) -> None:  # noqa: ARG002
        predicted = self._predict(batch)
        self._score_members(batch, predicted)
        self.valid_errors.update(batch, predicted.position, predicted.fields)

    def test_step(self, batch: Window, batch_idx: int) -> Tensor:  # noqa: ARG002
        with torch.autocast(self.device.type, enabled=False):  # in the precision that trained models are used in
            predicted = self._predict(batch)
            self._score_members(batch, predicted)
        self.test_errors.update(batch, predicted.position, predicted.fields)
        return predicted.position

    def _score_members(self, batch: Window, predicted: Rollout) -> None:
        """Add the scores of members, if they are asked for, beside the one rollout."""
        if self.ensemble is not None:
            for row in range(len(batch.frames)):
                self.ensemble.update(batch.scenes([row]), predicted.position[[row]])

    def predict_step(self, batch: Window, batch_idx: int) -> Tensor | Rollout:  # noqa: ARG002
        """(B, T - 2, N, D) predicted positions; with the fields where the scene has any that evolve."""
        predicted = self._predict(batch)
        return predicted if predicted.fields else predicted.position

    def _predict(self, batch: Window) -> Rollout:
        start, frames, rows = batch.initial, batch.target.shape[1], self.rows(batch)
        prescribed = Prescribed.of(batch)
        if len(rows) == 1:
            return predict_rollout(self.emulator, start, frames, RolloutOptions(prescribed))

        def predict(part: slice) -> Rollout:
            given = prescribed and prescribed.scenes(part)
            return predict_rollout(self.emulator, start.scenes(part), frames, RolloutOptions(given))

        return Rollout.stack(on_threads(predict, rows, self.threads or len(rows)))

    def rows(self, batch: Window) -> list[slice]:
        """The rows of the parts of a batch that a thread each computes, on a CPU.

        All in one where torch compiles for a shape, or noise is drawn for all windows together.
        """
        compiled = self.compiled or self.emulator.shapes_are_compiled
        whole = self.device.type != "cpu" or compiled or self.emulator.recipe.grid_noise > 0
        return split_rows(len(batch.frames), 1 if whole else self.parts or min(torch.get_num_threads(), MOST_PARTS))

    def on_validation_epoch_start(self) -> None:
        self.valid_errors.reset()
        self._start_ensemble(VALIDATED if self.members > 1 else None)

    def on_test_epoch_start(self) -> None:
        self.test_errors.reset()
        self._start_ensemble(self.tested_members)

    def _start_ensemble(self, members: int | None) -> None:
        every = self.reading.every
        self.ensemble = None if members is None else EnsembleTest(self.emulator, members, every=every)

    def on_validation_epoch_end(self) -> None:
        errors = self.valid_errors.compute()
        trained = self.emulator.frames * self.unroll
        horizon = trained * self.reading.every // self.reading.between  # in frames of the data
        overall = overall_error(errors, max(1, horizon))
        if self.ensemble is not None:
            self.ensemble.gather()
            overall = torch.tensor(self.ensemble.overall_score(), device=self.device)
        self.log_dict({f"valid/{name}": value for name, value in (errors | {preflight.OVERALL: overall}).items()})

    def on_test_epoch_end(self) -> None:
        if self.ensemble is not None:
            self.ensemble.gather()
        self.log_dict({f"test/{name}": value for name, value in self.test_errors.compute().items()})


def load_module(path: Path) -> EmulatorModule:
    """Load the module of a checkpoint onto the CPU.

    Raises:
        DataError, ConfigError: if the file is not a checkpoint of an emulator, or of a newer version.
    """
    content = checkpoints.read_checkpoint(path)
    stored = content.get("hyper_parameters", {})
    if not isinstance(stored, dict) or not isinstance(stored.get("scene", {}), dict):
        raise DataError(f"{path} is not a checkpoint of an emulator: its hyperparameters are not named values.")
    try:
        module = EmulatorModule(**stored)
        module.on_load_checkpoint(content)
        module.load_state_dict(content["state_dict"])
    except NmpmError:
        raise
    except Exception as error:  # hyperparameters of a foreign or damaged file may have any type and value
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise DataError(f"{path} is not a checkpoint of an emulator of this version ({reason}).") from error
    return module


def check_window(batch: object) -> Window:
    """The batch; raises ConfigError if another loader than nmpm's has made it."""
    if isinstance(batch, Window):
        return batch
    raise ConfigError(
        f"The loader's batches are of the type {type(batch).__name__}, not nmpm.particles.Window: give the Trainer a"
        " datamodule, nmpm.TrajectoryDataModule(path=...), or a DataLoader of windows."
    )


def repeated(batch: B, members: int) -> B:
    """Each scene of a batch so many times, one after the other."""
    if members == 1:
        return batch
    return batch.scenes([scene for scene in range(len(batch.mask)) for _ in range(members)])
