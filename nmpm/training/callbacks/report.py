"""The report of a test: a table on the screen, the figures as JSON and CSV, a picture and an animation."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.trainer.states import TrainerFn
from rich.console import Console
from torch import Tensor

from nmpm._support.atomic import atomic_write
from nmpm._support.collectives import all_gather
from nmpm._support.devices import device_name, join_hardware
from nmpm._support.digests import float32_digest
from nmpm._support.version import __version__
from nmpm.data.loading.evaluation import EvaluationLoader
from nmpm.evaluation.figures import error_table, no_better_than_trivial
from nmpm.evaluation.pictures import labelled_trajectories
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.training.module import OVERALL, EmulatorModule
from nmpm.viz import write_animation, write_snapshots


class ReportWriter(Callback):
    """Measures the time that training takes and the errors on the way, prints errors, and reports when a test ends.

    Into the trainer's `default_root_dir` go `report.json` (all figures, with hardware and versions; a remark where the
    model is no better than a trivial predictor), `errors.csv` (error against frame), `rollout.png` and `rollout.gif`
    (the first test trajectory beside its prediction).
    """

    def __init__(self) -> None:
        self.trained_seconds = 0.0
        self.trained_steps = 0
        self.trained_precision = ""
        self.trained_hardware = ""
        self.curve: list[list[float]] = []  # seconds of training, steps, MSE and overall error of each validation
        self._since: float | None = None
        self._trained = False
        self._first_rollout: tuple[Window, Tensor] | None = None

    @property
    def state_key(self) -> str:
        return "Report"  # its name in checkpoints of earlier versions

    def state_dict(self) -> dict[str, Any]:
        return {
            "trained_seconds": self._elapsed(),
            "trained_steps": self.trained_steps,
            "trained_precision": self.trained_precision,
            "trained_hardware": self.trained_hardware,
            "curve": list(self.curve),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if self._trained:
            return  # the test after a fit loads the best checkpoint, which is often older than the training's end
        self.trained_seconds = float(state_dict["trained_seconds"])
        self.trained_steps = int(state_dict.get("trained_steps", 0))
        self.trained_precision = str(state_dict.get("trained_precision", ""))
        self.trained_hardware = str(state_dict.get("trained_hardware", ""))
        self.curve = list(state_dict.get("curve", []))

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self._trained = True  # also where no step is left to take

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._since = time.monotonic()
        self.trained_precision = str(trainer.precision)
        hardware = device_name(trainer.strategy.root_device, getattr(pl_module, "threads", None))
        self.trained_hardware = join_hardware(self.trained_hardware, hardware)

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,  # noqa: ARG002
        outputs: Any,  # noqa: ARG002
        batch: Any,  # noqa: ARG002
        batch_idx: int,  # noqa: ARG002
    ) -> None:
        self.trained_steps = trainer.global_step

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        found = trainer.callback_metrics
        errors = [float(found[name]) for name in ("valid/mse", f"valid/{OVERALL}") if name in found]
        if self._trained and not trainer.sanity_checking and errors:
            self.curve.append([round(self._elapsed(), 1), self.trained_steps, *errors])
        if trainer.state.fn == TrainerFn.VALIDATING and not self._trained and trainer.is_global_zero:
            dataset = trainer.datamodule.description  # type: ignore[attr-defined]  # (Lightning sets it)
            _print_table(f"{dataset}: validation", _logged(trainer, "valid/"))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        self.trained_seconds, self._since = self._elapsed(), None

    def on_test_batch_end(
        self,
        trainer: Trainer,  # noqa: ARG002
        pl_module: LightningModule,  # noqa: ARG002
        outputs: Any,
        batch: Window,
        batch_idx: int,
        dataloader_idx: int = 0,  # noqa: ARG002
    ) -> None:
        if batch_idx == 0:
            self._first_rollout = (batch.to("cpu"), outputs.cpu())

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not isinstance(pl_module, EmulatorModule):
            return
        order = _tested(trainer)
        errors = {kind: _gather_ranks(metric, order) for kind, metric in pl_module.test_errors.errors.items()}
        if not trainer.is_global_zero:
            return
        folder = Path(trainer.default_root_dir)
        figures = self._figures(trainer, pl_module, {kind: rows for kind, (rows, _) in errors.items()})
        _write_report(folder, figures)
        _print_table(f"{figures['dataset']}: test", figures["test"])
        _write_curves(folder / "errors.csv", {kind: curves for kind, (_, curves) in errors.items()})
        if self._first_rollout is not None:
            trajectories = labelled_trajectories(pl_module.emulator.scene, *self._first_rollout)
            write_snapshots(trajectories, folder / "rollout.png")
            write_animation(trajectories, folder / "rollout.gif")
        Console().print(f"written to {folder}: report.json, errors.csv, rollout.png, rollout.gif")

    def report_untested(self, trainer: Trainer, module: EmulatorModule, reason: str) -> None:
        """Write and print the report of a training that ends without a test."""
        if trainer.is_global_zero:
            folder = Path(trainer.default_root_dir)
            _write_report(folder, self._figures(trainer, module, {}) | {"not_tested": reason})
            Console().print(f"Not tested: {reason} Written to {folder}: report.json", soft_wrap=True)

    def _elapsed(self) -> float:
        return self.trained_seconds + (time.monotonic() - self._since if self._since is not None else 0.0)

    def _figures(
        self, trainer: Trainer, module: EmulatorModule, per_trajectory: Mapping[str, list[dict[str, float]]]
    ) -> dict[str, Any]:
        datamodule = trainer.datamodule  # type: ignore[attr-defined]  # (Lightning sets it)
        errors = _logged(trainer, "test/")
        remark = no_better_than_trivial(errors)
        return {
            "dataset": datamodule.description,
            "weights": float32_digest(module.state_dict()),
            **({"test": errors} if errors else {}),
            **({"remark": remark} if remark else {}),
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
            **_simulation(datamodule),
            **({} if self._first_rollout is None else {"particles": int(self._first_rollout[0].mask[0].sum())}),
            "versions": {"nmpm": __version__, "torch": torch.__version__, "python": platform.python_version()},
        }


def _simulation(datamodule: Any) -> dict[str, Any]:
    """How the data were simulated, as far as their metadata say: preset, trajectories per split, seed, revision."""
    source = getattr(datamodule, "data_source", None)
    stated = source.metadata.extra.get("simulation") if source is not None else None
    return {"simulation": stated} if isinstance(stated, dict) else {}


def _tested(trainer: Trainer) -> list[int]:
    """Indices of the tested trajectories of all processes, in the order in which metrics join them."""
    loader = trainer.test_dataloaders
    batches = loader.batches[: int(trainer.num_test_batches[0])] if isinstance(loader, EvaluationLoader) else ()
    return [index for own in all_gather([index for batch in batches for index in batch]) for index in own]


def _gather_ranks(metric: MSE, order: Sequence[int]) -> tuple[list[dict[str, float]], list[Tensor]]:
    """MSE per trajectory and curves, from all processes, in the order of the split."""
    with metric.sync_context():
        rows, curves = metric.per_trajectory(), [curve.cpu() for curve in metric.curves()]
    places = sorted(range(len(rows)), key=order.__getitem__) if order else range(len(rows))
    return [rows[place] for place in places], [curves[place] for place in places]


def _write_report(folder: Path, figures: Mapping[str, Any]) -> None:
    with atomic_write(folder / "report.json") as part:
        part.write_text(json.dumps(figures, indent=1) + "\n")


def _write_curves(path: Path, curves: Mapping[str, list[Tensor]]) -> None:
    """Mean over trajectories of the squared error at each frame that all of them reach, a column per predictor."""
    frames = min(len(curve) for rows in curves.values() for curve in rows)
    means = torch.stack([torch.stack([curve[:frames] for curve in rows]).mean(0) for rows in curves.values()], dim=1)
    lines = [["frame", *curves], *([str(frame), *map(str, row)] for frame, row in enumerate(means.tolist(), 1))]
    with atomic_write(path) as part:
        part.write_text("".join(",".join(line) + "\n" for line in lines))


def _logged(trainer: Trainer, prefix: str) -> dict[str, float]:
    """What an evaluation has logged, by names without the prefix."""
    logged = sorted(trainer.callback_metrics.items())
    return {key.removeprefix(prefix): float(value) for key, value in logged if key.startswith(prefix)}


def _print_table(what: str, errors: Mapping[str, float]) -> None:
    Console().print(error_table(what, errors))
    if remark := no_better_than_trivial(errors):
        Console().print(remark, soft_wrap=True)
