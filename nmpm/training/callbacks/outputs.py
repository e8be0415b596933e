"""What a test and a prediction write: report, curves of errors, picture and animation; trajectories."""

from __future__ import annotations

import json
import platform
import shlex
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import BasePredictionWriter
from lightning.pytorch.trainer.states import TrainerFn
from rich.console import Console
from torch import Tensor

from nmpm._support import __version__
from nmpm._support.atomic import atomic_write
from nmpm._support.collectives import all_gather, gather_to_rank0, rank_and_world_size
from nmpm._support.machine import device_name, join_hardware
from nmpm._support.messages import one_line
from nmpm.data.format import Trajectory
from nmpm.data.predictions import predicted_trajectory
from nmpm.data.recordings import EvaluationLoader
from nmpm.data.write.vtk import write_viewable
from nmpm.emulator import Rollout
from nmpm.emulator.digests import float32_digest
from nmpm.evaluation.figures import ensemble_table, error_table, no_better_than_trivial
from nmpm.evaluation.pictures import labelled_trajectories
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.scene import Scene
from nmpm.training.module import EmulatorModule
from nmpm.training.preflight import OVERALL
from nmpm.viz import write_animation, write_snapshots


class ReportWriter(Callback):
    """Measures the time that training takes and the errors on the way, prints errors, and reports when a test ends.

    Into the trainer's `default_root_dir` go `report.json` (all figures, with hardware and versions; a remark where the
    model is no better than a trivial predictor), `errors.csv` (error against frame), `rollout.png` and `rollout.gif`
    (the first test trajectory beside its prediction).
    """

    _KEPT = ("trained_seconds", "trained_steps", "trained_precision", "trained_hardware", "curve")  # in checkpoints

    def __init__(self) -> None:
        self.trained_seconds, self.trained_steps = 0.0, 0
        self.trained_precision = self.trained_hardware = ""
        self.curve: list[list[float]] = []  # seconds of training, steps, MSE and overall error of each validation
        self.progress = ""  # from the start of a fine-tuning to its best validation, in words
        self._since: float | None = None
        self._fitting = False
        self._first_rollout: tuple[Window, Tensor] | None = None

    def state_dict(self) -> dict[str, Any]:
        kept = {name: getattr(self, name) for name in self._KEPT}
        return kept | {"trained_seconds": self._elapsed(), "curve": list(self.curve)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if not self._fitting:  # the test after a fit loads the best checkpoint, often older than the training's end
            for name in self._KEPT:
                setattr(self, name, copy(state_dict[name]))

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._fitting = True  # also where no step is left to take

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._since = time.monotonic()
        self.trained_precision = str(trainer.precision)
        hardware = device_name(trainer.strategy.root_device, getattr(pl_module, "threads", None))
        self.trained_hardware = join_hardware(self.trained_hardware, hardware)

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        self.trained_steps = trainer.global_step

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        logged = trainer.callback_metrics
        errors = [float(logged[name]) for name in ("valid/mse", f"valid/{OVERALL}") if name in logged]
        if self._fitting and not trainer.sanity_checking and errors:
            self.curve.append([round(self._elapsed(), 1), self.trained_steps, *errors])
        if trainer.state.fn == TrainerFn.VALIDATING and not self._fitting and trainer.is_global_zero:
            dataset = trainer.datamodule.description  # type: ignore[attr-defined]  # (Lightning sets it)
            _print_table(f"{dataset}: validation", _logged(trainer, "valid/"))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.trained_seconds, self._since = self._elapsed(), None

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Window, batch_idx: int, *_: Any
    ) -> None:
        if batch_idx == 0:
            self._first_rollout = (batch.to("cpu"), outputs.cpu())

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not isinstance(pl_module, EmulatorModule):
            return
        order = _tested_indices(trainer)
        errors = {kind: _gather_ranks(metric, order) for kind, metric in pl_module.test_errors.errors.items()}
        if not trainer.is_global_zero:
            return
        folder = Path(trainer.default_root_dir)
        figures = self._figures(trainer, pl_module, {kind: rows for kind, (rows, _) in errors.items()})
        _write_report(folder, figures)
        self._print_progress()
        _print_table(f"{figures['dataset']}: test", figures["test"])
        if "ensemble" in figures:
            Console().print(ensemble_table(f"{figures['dataset']}:", figures["ensemble"]))
        curves = {kind: values for kind, (_, values) in errors.items()}
        _write_curves(folder / "errors.csv", curves, pl_module.reading.every)
        written = ["report.json", "errors.csv"]
        if self._first_rollout is not None:
            written += _draw(pl_module.emulator.scene, *self._first_rollout, folder)
        Console().print(f"written to {folder}: {', '.join(written)}", soft_wrap=True)

    def report_untested(self, trainer: Trainer, module: EmulatorModule, reason: str) -> None:
        """Write and print the report of a training that ends without a test."""
        if trainer.is_global_zero:
            folder = Path(trainer.default_root_dir)
            _write_report(folder, self._figures(trainer, module, {}) | {"not_tested": reason})
            self._print_progress()
            Console().print(f"Not tested: {reason} Written to {folder}: report.json", soft_wrap=True)

    def _print_progress(self) -> None:
        if self.progress:
            Console().print(self.progress, soft_wrap=True)

    def _elapsed(self) -> float:
        return self.trained_seconds + (time.monotonic() - self._since if self._since is not None else 0.0)

    def _figures(
        self, trainer: Trainer, module: EmulatorModule, per_trajectory: Mapping[str, list[dict[str, float]]]
    ) -> dict[str, Any]:
        datamodule = trainer.datamodule  # type: ignore[attr-defined]  # (Lightning sets it)
        errors, source = _logged(trainer, "test/"), getattr(datamodule, "data_source", None)
        simulation = source.metadata.extra.get("simulation") if source else None
        optional = {
            "progress": self.progress,
            "test": errors,
            "remark": no_better_than_trivial(errors),
            "ensemble": module.ensemble and module.ensemble.to_dict(),
            "simulation": simulation if isinstance(simulation, dict) else None,
            "particles": self._first_rollout and int(self._first_rollout[0].mask[0].sum()),
        }
        return {
            "dataset": datamodule.description,
            "weights": float32_digest(module.state_dict()),
            **{key: value for key, value in optional.items() if value},
            "per_trajectory": dict(per_trajectory),
            "training": {
                "steps": self.trained_steps,
                "horizon": module.emulator.frames * module.unroll,
                "seconds": round(self.trained_seconds, 1),
                "precision": self.trained_precision or str(trainer.precision),
                "devices": trainer.world_size,
                "hardware": self.trained_hardware or device_name(trainer.strategy.root_device, module.threads),
                "parameters": sum(parameter.numel() for parameter in module.emulator.parameters()),
            },
            "curve": self.curve,
            "versions": {"nmpm": __version__, "torch": torch.__version__, "python": platform.python_version()},
        }


def _tested_indices(trainer: Trainer) -> list[int]:
    """Indices of the tested trajectories of all processes, in the order in which metrics join them."""
    loader = trainer.test_dataloaders
    batches = loader.batches[: int(trainer.num_test_batches[0])] if isinstance(loader, EvaluationLoader) else ()
    by_rank = all_gather([index for batch in batches for index in batch])
    return [index for indices in by_rank for index in indices]


def _gather_ranks(metric: MSE, order: Sequence[int]) -> tuple[list[dict[str, float]], list[Tensor]]:
    """MSE per trajectory and curves, from all processes, in the order of the split."""
    with metric.sync_context():
        rows, curves = metric.per_trajectory(), [curve.cpu() for curve in metric.curves()]
    ranked = sorted(range(len(rows)), key=order.__getitem__) if order else range(len(rows))
    return [rows[index] for index in ranked], [curves[index] for index in ranked]


def _write_report(folder: Path, figures: Mapping[str, Any]) -> None:
    with atomic_write(folder / "report.json") as part:
        part.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def _write_curves(path: Path, curves: Mapping[str, list[Tensor]], every: int) -> None:
    """Mean over trajectories of the squared error at each frame that all of them reach, a column per predictor.

    Frames are those of the data, of which the model predicts each `every`-th.
    """
    frames = min(len(curve) for rows in curves.values() for curve in rows)
    means = torch.stack([torch.stack([curve[:frames] for curve in rows]).mean(0) for rows in curves.values()], dim=1)
    lines = [["frame", *curves], *([str(frame * every), *map(str, row)] for frame, row in enumerate(means.tolist(), 1))]
    with atomic_write(path) as part:
        part.write_text("".join(",".join(line) + "\n" for line in lines), encoding="utf-8")


def _draw(scene: Scene, window: Window, predicted: Tensor, folder: Path) -> list[str]:
    """Draw a picture and an animation of a rollout; names of the files, without one that cannot be drawn."""
    written = []
    for name in ("rollout.png", "rollout.gif"):
        write = write_animation if name.endswith(".gif") else write_snapshots
        try:
            write(labelled_trajectories(scene, window, predicted), folder / name)
            written.append(name)
        except Exception as error:  # the results of a training are worth more than its pictures
            warnings.warn(f"{name} is not drawn: {one_line(error) or type(error).__name__}", stacklevel=2)
    return written


def _logged(trainer: Trainer, prefix: str) -> dict[str, float]:
    """Values that an evaluation has logged, by names without the prefix."""
    logged = sorted(trainer.callback_metrics.items())
    return {key.removeprefix(prefix): float(value) for key, value in logged if key.startswith(prefix)}


def _print_table(title: str, errors: Mapping[str, float]) -> None:
    Console().print(error_table(title, errors))
    if remark := no_better_than_trivial(errors):
        Console().print(remark, soft_wrap=True)


class PredictionWriter(BasePredictionWriter):
    """Writes what `nmpm predict` predicts to `predictions.h5` in the run's folder.

    Rank 0 writes the predictions of all ranks, in the order of the test split.
    """

    def __init__(self) -> None:
        super().__init__(write_interval="batch")
        self._predicted: dict[int, Trajectory] = {}

    def write_on_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, prediction: Any, indices: Any, batch: Window, number: int,
        *_: Any,
    ) -> None:  # fmt: skip
        scene: Scene = pl_module.emulator.scene  # type: ignore[union-attr,assignment]  # (an EmulatorModule)
        source = str(trainer.ckpt_path or "the model")
        rollout = prediction if isinstance(prediction, Rollout) else Rollout(prediction, {})
        loader = trainer.predict_dataloaders
        for row, index in enumerate(self._split_indices(loader, number, len(rollout.position))):
            predicted = predicted_trajectory(
                scene,
                batch.initial,
                rollout.position,
                source,
                row,
                rollout.fields,
                real=batch.mask,
                obstacle_frames=batch.obstacle_frames,
            )
            known = (
                loader.recordings.as_recorded(predicted, index) if isinstance(loader, EvaluationLoader) else predicted
            )
            self._predicted[index] = known

    def _split_indices(self, loader: object, batch: int, count: int) -> Sequence[int]:
        """Where the trajectories of a batch belong in the file."""
        if isinstance(loader, EvaluationLoader):
            return loader.batches[batch]
        rank, world = rank_and_world_size()  # of another loader: in the order of arrival, ranks in turn
        first = rank + world * len(self._predicted)
        return range(first, first + world * count, world)

    def on_predict_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        by_rank = gather_to_rank0(self._predicted)
        if trainer.is_global_zero:
            path = Path(trainer.default_root_dir) / "predictions.h5"
            predicted = dict(pair for rank in by_rank for pair in rank.items())
            write_viewable(path, [predicted[index] for index in sorted(predicted)])
            sys.stdout.write(f"written to {path}; to draw them: nmpm render {shlex.quote(str(path))}\n")
        self._predicted = {}
