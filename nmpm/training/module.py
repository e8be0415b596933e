"""The LightningModule: unrolled training, full rollouts for validation and test, beside the trivial predictors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np
import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor
from torch.optim import Optimizer
from torch.utils.checkpoint import checkpoint

from nmpm._support.collectives import normal_like, of_all, of_the_first, share_of
from nmpm._support.specs import from_spec, to_spec
from nmpm.decoders import Decoder, Residual
from nmpm.emulator.calibration import calibrate
from nmpm.emulator.compilation import compile_network
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.model import Bundle, Emulator
from nmpm.emulator.rollouts import rollout, unroll
from nmpm.errors import ConfigError
from nmpm.evaluation.comparison import Comparison
from nmpm.evaluation.metrics import EarthMover
from nmpm.particles import Particles, Window
from nmpm.processors import Processor, UNet
from nmpm.scene import Scene
from nmpm.training.augmentation import check_mirrors, mirrored
from nmpm.training.losses import position_error
from nmpm.training.schedules import Schedule
from nmpm.transfer import Linear, Transfer

OptimizerCallable = Callable[[Iterable], Optimizer]  # type: ignore[type-arg]  # (jsonargparse knows this form)

CALIBRATION_BATCHES = 4


def adam(parameters: Iterable[Tensor]) -> Optimizer:
    """The paper's optimizer."""
    return torch.optim.Adam(parameters, lr=1e-3)


class EmulatorModule(LightningModule):
    """Trains an emulator on windows and judges it by rollouts.

    Args:
        scene: The facts of the scenes; from the command line it comes from the data.
        cells: Grid cells along the longest axis, or along each.
        frames: m, frames predicted by one call of the processor (time bundling).
        unroll: K, calls that a training step backpropagates through; the training horizon is m K frames.
        unroll_growth: Share of the training, in [0, 1], over which the calls grow from 1 to K: early steps are cheap.
        transfer: How particles and grid see each other.
        processor: The network on the grid.
        decoder: What the network's output means.
        constraints: Facts that rollouts are held to; but for the bounds they do not act in training.
        optimizer: Makes the optimizer from the parameters.
        schedule: The learning rate's course over the training.
        position_noise: Standard deviation of the noise on a training window's initial positions, in domain lengths.
        grid_noise: Standard deviation of the noise on the normalised grid state in training.
        mirror: Axes along which half of the training windows are mirrored; those without gravity.
        horizons: Frames at which rollout errors are reported, beside the full rollout.
        emd: Every how many frames to compute the exact earth mover's distance in tests; 0 for never (it is slow).
        recompute: Whether gradients recompute each bundle instead of keeping what they need of it: the memory of one
            bundle instead of K, for the time of one more forward pass.
        compile: Whether to compile the network by torch.compile, where that works. It takes half a minute or more at
            the start; on a CPU it gains next to nothing.
        seed: Of the noise.
    """

    def __init__(
        self,
        scene: Scene,
        cells: int | list[int] = 64,
        frames: int = 8,
        unroll: int = 2,
        unroll_growth: float = 0.0,
        transfer: Transfer = Linear(),  # noqa: B008 (frozen)
        processor: Processor = UNet(),  # noqa: B008
        decoder: Decoder = Residual(),  # noqa: B008
        constraints: Constraints = Constraints(),  # noqa: B008
        optimizer: OptimizerCallable = adam,
        schedule: Schedule = Schedule(),  # noqa: B008
        position_noise: float = 0.0,
        grid_noise: float = 0.0,
        mirror: Sequence[int] = (),
        horizons: Sequence[int] = (1, 8, 32, 100),
        emd: int = 0,
        recompute: bool = False,
        compile: bool = False,  # noqa: A002 (torch's word)
        seed: int = 0,
    ) -> None:
        super().__init__()
        scene = scene if isinstance(scene, Scene) else Scene.from_dict(scene)
        transfer, decoder = from_spec(transfer, Transfer), from_spec(decoder, Decoder)
        processor = from_spec(processor, Processor)
        constraints = constraints if isinstance(constraints, Constraints) else Constraints(**constraints)
        self.emulator = Emulator(scene, cells, frames, transfer, processor, decoder, grid_noise, constraints)
        if not 0 <= unroll_growth <= 1:
            raise ConfigError(f"model.unroll_growth = {unroll_growth} is a share of the training, in [0, 1].")
        self.unroll, self.unroll_growth = unroll, unroll_growth
        self.make_optimizer = optimizer
        self.schedule = schedule if isinstance(schedule, Schedule) else Schedule(**schedule)
        check_mirrors(scene, mirror)
        self.position_noise, self.mirror = position_noise, tuple(mirror)
        self.recompute, self.compiled = recompute, compile
        self.seed = seed
        self.save_hyperparameters(
            {
                "scene": scene.to_dict(),
                "cells": list(self.emulator.grid.shape),
                "frames": frames,
                "unroll": unroll,
                "unroll_growth": unroll_growth,
                "transfer": to_spec(transfer),
                "processor": to_spec(processor),
                "decoder": to_spec(decoder),
                "constraints": dataclasses.asdict(constraints),
                "schedule": to_spec(self.schedule)["init_args"],
                "position_noise": position_noise,
                "grid_noise": grid_noise,
                "mirror": list(mirror),
                "horizons": list(horizons),
                "emd": emd,
                "recompute": recompute,
                "compile": compile,
                "seed": seed,
            },
            logger=False,
        )
        self.valid_errors = Comparison(scene, horizons)
        self.test_errors = Comparison(scene, horizons)
        self.earth_mover = EarthMover(emd) if emd else None
        self.validated_step = -1

    @classmethod
    def of(cls, emulator: Emulator, **options: Any) -> EmulatorModule:
        """A module that trains an emulator on: the same form, a copy of its weights and statistics.

        Args:
            emulator: For example `Zoo.load("goop").emulator`.
            options: What else the constructor takes, such as `unroll` and `optimizer`.
        """
        module = cls(
            emulator.scene,
            cells=list(emulator.grid.shape),
            frames=emulator.frames,
            transfer=emulator.transfer,
            processor=emulator.recipe,
            decoder=emulator.decoder,
            constraints=emulator.constraints,
            **options,
        )
        module.emulator.load_state_dict(emulator.state_dict())
        return module

    def setup(self, stage: str) -> None:
        """Check that the data are of the model's scene; for a training, calibrate and compile what is to be.

        Raises:
            ConfigError: if the data's scene is another.
        """
        theirs = getattr(getattr(self.trainer, "datamodule", None), "scene", None)
        if isinstance(theirs, Scene):
            _check_same(self.emulator.scene, theirs)
        if stage == "fit" and not self.emulator.calibrated:
            loader = self.trainer.datamodule.train_dataloader()  # type: ignore[attr-defined]  # (Lightning sets it)
            calibrate(self.emulator, list(islice(loader, CALIBRATION_BATCHES)))
        if stage == "fit" and self.compiled:
            example = self.emulator.input_mean.expand(1, -1, *self.emulator.grid.shape)
            compile_network(self.emulator.processor, example)

    def on_train_batch_start(self, batch: Window, batch_idx: int) -> None:  # noqa: ARG002
        """Make the batch's randomness a function of its number, so that a resumed run repeats it.

        It is the same for all processes: each takes its own rows of what is drawn for all.
        """
        entropy = (self.seed, 0, self.trainer.fit_loop.total_batch_idx)
        torch.manual_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))

    def training_step(self, batch: Window, batch_idx: int) -> Tensor:  # noqa: ARG002
        """This process's part of the mean error over the particles of all processes, which is what is logged.

        Over several batches (`accumulate_grad_batches`) Lightning takes the plain mean, so that a particle weighs a
        little more in a batch with fewer.
        """
        for axis in self.mirror:
            chances = share_of(lambda rows: torch.rand(rows, device=self.device), len(batch.frames))
            batch = mirrored(batch, self.emulator.scene, axis, chances < 0.5)
        bundles = self._unrolled(self._perturbed(batch.initial), self.bundles(self._progress()))
        predicted = torch.cat([bundle.position for bundle in bundles], dim=1)
        error = position_error(predicted, batch.target[:, : predicted.shape[1]], batch.mask, self.emulator.grid)
        loss, logged = of_all(error, batch.mask.sum())
        self.log("train/loss", logged, prog_bar=True)
        return loss

    def validation_step(self, batch: Window, batch_idx: int) -> None:
        self.valid_errors.update(batch, self.predict_step(batch, batch_idx))

    def test_step(self, batch: Window, batch_idx: int) -> Tensor:
        predicted = self.predict_step(batch, batch_idx)
        self.test_errors.update(batch, predicted)
        if self.earth_mover is not None:
            self.earth_mover.update(predicted, batch.target, batch.mask, batch.material)
        return predicted

    def predict_step(self, batch: Window, batch_idx: int) -> Tensor:  # noqa: ARG002
        """(B, T - 2, N, D) predicted positions."""
        return rollout(self.emulator, batch.initial, batch.target.shape[1])

    def on_validation_epoch_start(self) -> None:
        self.valid_errors.reset()

    def on_test_epoch_start(self) -> None:
        self.test_errors.reset()
        if self.earth_mover is not None:
            self.earth_mover.reset()

    def on_validation_epoch_end(self) -> None:
        self.log_dict({f"valid/{name}": value for name, value in self.valid_errors.compute().items()})
        self.validated_step = self.global_step

    def on_test_epoch_end(self) -> None:
        figures = self.test_errors.compute()
        if self.earth_mover is not None:
            figures |= self.earth_mover.compute()
        self.log_dict({f"test/{name}": value for name, value in figures.items()})

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        optimizer = self.make_optimizer(self.emulator.parameters())
        total = self.trainer.estimated_stepping_batches
        scheduler = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: self.schedule.factor(max(step, self._clock() * total), total)
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def bundles(self, progress: float) -> int:
        """How many bundles a step unrolls when this share of the training is over."""
        if progress >= self.unroll_growth:
            return self.unroll
        return 1 + int((self.unroll - 1) * progress / self.unroll_growth)

    def _progress(self) -> float:
        """Share of the training that is over, by steps or by the clock, whichever is further."""
        if not self.unroll_growth:
            return 1.0
        return max(self.global_step / self.trainer.estimated_stepping_batches, self._clock())

    def _unrolled(self, particles: Particles, count: int) -> Iterator[Bundle]:
        if not self.recompute:
            yield from unroll(self.emulator, particles, count)
            return
        solid = self.emulator.solid(particles)
        for _ in range(count):
            bundle: Bundle = checkpoint(self.emulator, particles, solid, use_reentrant=False)
            yield bundle
            particles = particles.moved(bundle.position[:, -1], bundle.velocity)

    def _clock(self) -> float:
        """Share of the trainer's `max_time` that is over, so that the rate comes down in time on a slow machine.

        By the clock of process 0: with rates of their own, the processes' weights would drift apart.
        """
        for callback in self.trainer.callbacks:  # type: ignore[attr-defined]  # (Lightning sets it)
            if isinstance(callback, Timer) and callback._duration:
                over = min(callback.time_elapsed() / callback._duration, 1.0)
                return of_the_first(over, self.trainer.strategy.root_device)
        return 0.0

    def _perturbed(self, particles: Particles) -> Particles:
        if self.position_noise <= 0:
            return particles
        noise = self.position_noise * normal_like(particles.position)
        return particles.moved(particles.position + noise, particles.velocity)


def _check_same(mine: Scene, theirs: Scene) -> None:
    different = mine.differences(theirs)
    if different:
        facts = "; ".join(f"{name} = {getattr(mine, name)}, not {getattr(theirs, name)}" for name in different)
        raise ConfigError(
            f"The model was made for other scenes than the data's: {facts}. For another box, or other particles, take"
            " EmulatorModule.of(emulator.over(data.scene)); what else differs needs a model of its own."
        )
