"""DeepMind's WaterDrop, where it is at hand: the trivial predictors' errors are known, and training on it works."""

import json

import pytest
import torch

from nmpm.cli import main
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.evaluation.comparison import Comparison
from nmpm.metrics import MSE


def test_trivial_predictors_on_waterdrop_are_as_published_and_free_fall_is_exact_at_32(recorded):
    folder = recorded / "deepmind-waterdrop"
    data = TrajectoryDataModule(path=str(folder), family="deepmind", gravity=[0.0, -9.81])
    comparison = Comparison(data.scene, [MSE((32,))])
    for window in data.test_dataloader():
        comparison.update(window, torch.zeros_like(window.target))
    still = [1e3 * row["mse"] for row in comparison.errors["still"].per_trajectory()]
    falling = [1e3 * row["mse"] for row in comparison.errors["free_fall"].per_trajectory()]
    assert (min(still), max(still)) == pytest.approx((71, 127), abs=1)
    assert (min(falling), max(falling)) == pytest.approx((40, 71), abs=1)
    assert max(1e3 * row["mse@32"] for row in comparison.errors["free_fall"].per_trajectory()) < 1e-4


def test_waterdrop_trains_and_reports_with_the_same_commands(recorded, tmp_path):
    words = [
        *("--config", "waterdrop.yaml", "--data.path", str(recorded / "deepmind-waterdrop")),
        *("--trainer.max_steps", "2", "--trainer.val_check_interval", "2", "--data.limit_eval", "1"),
        *("--model.processor.width", "4", "--model.unroll", "1", "--data.batch_size", "2"),
        *("--trainer.default_root_dir", str(tmp_path), "--trainer.accelerator", "cpu"),
        *("--trainer.enable_progress_bar", "false", "--data.buffer_size", "2"),
    ]
    assert main(["fit", *words]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["dataset"] == "deepmind-waterdrop"
    assert len(report["per_trajectory"]["model"]) == 3
    assert len((tmp_path / "errors.csv").read_text().splitlines()) == 1000
