"""Two processes on the CPU (gloo) give what one gives."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMON = [
    *("--config", "waterdrop.yaml", "--model.unroll", "1", "--model.processor.width", "4"),
    *("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false", "--trainer.precision", "32-true"),
]


def nmpm(command: str, *words: str, devices: int) -> None:
    spread = ["--trainer.devices", str(devices), "--trainer.strategy", "ddp" if devices > 1 else "auto"]
    subprocess.run(
        [sys.executable, "-m", "nmpm", command, *COMMON, *words, *spread],
        check=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        timeout=240,
    )


@pytest.mark.slow
def test_two_processes_measure_what_one_measures(make_dataset, tmp_path):
    sizes = ((30, 9), (40, 7), (30, 8))
    data = ["--data.path", str(make_dataset(train=sizes, valid=sizes, test=sizes))]
    root = tmp_path / "two"
    short = ["--trainer.max_steps", "3", "--trainer.val_check_interval", "3", "--data.batch_size", "2"]
    nmpm("fit", *data, *short, "--trainer.default_root_dir", str(root), devices=2)
    report = json.loads((root / "report.json").read_text())
    assert report["training"]["devices"] == 2
    best = str(root / "checkpoints" / "best.ckpt")
    nmpm("test", *data, "--ckpt_path", best, "--trainer.default_root_dir", str(tmp_path / "one"), devices=1)
    alone = json.loads((tmp_path / "one" / "report.json").read_text())
    assert alone["test"] == pytest.approx(report["test"], rel=1e-5)
    counted = sorted(row["mse"] for row in report["per_trajectory"]["model"])
    assert counted == pytest.approx(sorted(row["mse"] for row in alone["per_trajectory"]["model"]), rel=1e-5)
    assert Path(root / "rollout.png").is_file()
