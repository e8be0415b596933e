"""Validation, test and prediction: full rollouts of trajectories, beside the trivial predictors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from lightning.pytorch import LightningModule
from torch import Tensor

from nmpm.emulator import Emulator, Prescribed, Rollout, RolloutOptions, predict_rollout
from nmpm.errors import ConfigError
from nmpm.evaluation.comparison import Comparison
from nmpm.evaluation.ensembles import EnsembleTest
from nmpm.metrics import MSE, RolloutMetric, overall_error
from nmpm.particles import Window
from nmpm.scene import Reading
from nmpm.training.backpropagation import MOST_PARTS, on_threads, split_rows
from nmpm.training.preflight import OVERALL

VALIDATED = 4
"""Members of each scene in validations of ensembles."""


def check_window(batch: object) -> Window:
    """The batch; raises ConfigError if another loader than nmpm's has made it."""
    if isinstance(batch, Window):
        return batch
    raise ConfigError(
        f"The loader's batches are of the type {type(batch).__name__}, not nmpm.particles.Window: give the Trainer a"
        " datamodule, nmpm.TrajectoryDataModule(path=...), or a DataLoader of windows."
    )


class EvaluatedModule(LightningModule):
    """Rolls an emulator out over whole trajectories and logs the errors; training is the subclass's.

    Args:
        emulator: To be evaluated.
        horizon: Frames of a training step, from which on the overall error counts, see `overall_error`.
        metrics: Errors that validations and tests report; None for the MSE.

    Attributes:
        parts: In how many parts a batch is computed on a CPU; None for as many as torch has threads, at most 4. Other
            numbers change results by rounding.
        threads: How many threads compute them; None for one each. Changes no result.
        compiled: Whether torch compiles the network, so that batches are not computed in parts.
        reading: How the data are read for the emulator; errors count frames of the data.
        members: Members that are trained; where there are several, the overall error of validations is their CRPS.
        tested_members: Members of which tests measure scores, too; None for none.
        ensemble: These scores, in tests of members and in validations of ensembles.
    """

    def __init__(self, emulator: Emulator, horizon: int, metrics: Sequence[RolloutMetric] | None) -> None:
        super().__init__()
        self.emulator, self.horizon = emulator, horizon
        self.parts: int | None = None
        self.threads: int | None = None
        self.compiled = False
        self.reading = Reading(emulator.scene)
        self.members = 1
        self.tested_members: int | None = None
        self.ensemble: EnsembleTest | None = None
        reported = [MSE()] if metrics is None else list(metrics)
        cheap = [metric for metric in reported if metric.cheap]
        self.valid_errors = Comparison(emulator.scene, cheap, emulator.frames)
        self.test_errors = Comparison(emulator.scene, reported, emulator.frames)

    def setup(self, stage: str) -> None:  # noqa: ARG002
        """Adopt the datamodule's reading."""
        plain = Reading(self.emulator.scene)
        self.reading = getattr(getattr(self.trainer, "datamodule", None), "reading", plain)
        for errors in (self.valid_errors, self.test_errors):
            errors.count_every(self.reading.every)

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
        horizon = self.horizon * self.reading.every // self.reading.between  # in frames of the data
        overall = overall_error(errors, max(1, horizon))
        if self.ensemble is not None:
            self.ensemble.gather()
            overall = torch.tensor(self.ensemble.overall_score(), device=self.device)
        self.log_dict({f"valid/{name}": value for name, value in (errors | {OVERALL: overall}).items()})

    def on_test_epoch_end(self) -> None:
        if self.ensemble is not None:
            self.ensemble.gather()
        self.log_dict({f"test/{name}": value for name, value in self.test_errors.compute().items()})
