"""Every kind of scene goes from the simulator to a tested checkpoint: obstacles, drawn gravity, materials, 3-D, SPH."""

import json

import pytest

from nmpm.cli import main
from nmpm.data import catalog


@pytest.mark.parametrize(
    ("name", "channels"),
    [
        ("waterramps", {"solid"}),
        ("variablegravity", {"solid", "gravity_x", "gravity_y"}),
        ("multimaterial", {"water.volume", "sand.volume", "goop.volume"}),
        ("waterdrop3d", {"water.velocity_z"}),
        ("dambreak2d", {"solid"}),
    ],
)
def test_simulated_scenes_train_and_report(name, channels, tmp_path, monkeypatch):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    words = [
        *("--config", "goop.yaml", "--data.name", name, "--data.source", "disk"),
        *("--data.generate", '{"counts": {"train": 2, "valid": 1, "test": 1}, "frames": 20}'),
        *("--trainer.max_steps", "2", "--trainer.val_check_interval", "2", "--trainer.max_time", "null"),
        *("--model.processor.width", "4", "--model.unroll", "1", "--data.batch_size", "2", "--data.buffer_size", "2"),
        *("--trainer.default_root_dir", str(tmp_path / "run"), "--trainer.accelerator", "cpu"),
        *("--trainer.enable_progress_bar", "false", "--model.cells", "24"),
    ]
    assert main(["fit", *words]) == 0
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["dataset"] == f"{name}, simulated by nmpm"
    assert channels <= set(catalog.scene(name).input_channels)
    assert len(report["per_trajectory"]["model"]) == 1
