"""Two processes on the CPU (gloo) give what one gives."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from nmpm.data.format import Split

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
    counted, rows = ([row["mse"] for row in found["per_trajectory"]["model"]] for found in (report, alone))
    assert counted == pytest.approx(rows, rel=1e-5)
    reach_32 = [["mse@32" in row for row in found["per_trajectory"]["model"]] for found in (report, alone)]
    assert reach_32 == [[False, True, False]] * 2  # in the order of the split, of which batches take equal lengths
    assert Path(root / "rollout.png").is_file()
    nmpm("predict", *data, "--ckpt_path", best, "--trainer.default_root_dir", str(root), devices=2)
    predicted = Split(root / "predictions.h5")
    assert [predicted.particles(index) for index in range(len(predicted))] == [9, 7, 8]


@pytest.mark.slow
def test_two_processes_train_on_one_trajectory_of_each_split(make_dataset, tmp_path):
    """The second process has nothing to validate or to test."""
    one = ((30, 9),)
    data = ["--data.path", str(make_dataset(train=one, valid=one, test=one)), "--data.batch_size", "2"]
    words = ["--trainer.max_steps", "2", "--trainer.val_check_interval", "1"]
    nmpm("fit", *data, *words, "--trainer.default_root_dir", str(tmp_path / "2"), devices=2)
    best = ["--ckpt_path", str(tmp_path / "2" / "checkpoints" / "best.ckpt")]
    nmpm("test", *data, *best, "--trainer.default_root_dir", str(tmp_path / "1"), devices=1)
    shared, alone = (json.loads((tmp_path / root / "report.json").read_text()) for root in ("2", "1"))
    assert shared["test"] == pytest.approx(alone["test"], rel=1e-5)
    assert len(shared["per_trajectory"]["model"]) == 1
    nmpm("predict", *data, *best, "--trainer.default_root_dir", str(tmp_path / "2"), devices=2)
    assert len(Split(tmp_path / "2" / "predictions.h5")) == 1


TRAIN_TO = """
import sys
from pathlib import Path

import torch
from lightning.pytorch import LightningModule, Trainer

from nmpm.data.datamodule import TrajectoryDataModule


class Diary(LightningModule):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))

    def training_step(self, batch, batch_idx):
        with (Path(sys.argv[2]) / f"rank_{self.global_rank}.txt").open("a") as file:
            file.write(f"{float(batch.frames.double().sum()):.12g}\\n")
        return self.weight * batch.frames.mean()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


Path(sys.argv[2]).mkdir(exist_ok=True)
data = TrajectoryDataModule(path=sys.argv[1], horizon=6, batch_size=2, buffer_size=2, passes=1, emphasis=0.3)
trainer = Trainer(
    accelerator="cpu", devices=2, strategy="ddp", max_steps=int(sys.argv[3]), limit_val_batches=0, logger=False,
    enable_checkpointing=False, enable_progress_bar=False, default_root_dir=sys.argv[2],
)
trainer.fit(Diary(), datamodule=data, ckpt_path=sys.argv[4] if len(sys.argv) > 4 else None)
trainer.save_checkpoint(Path(sys.argv[2]) / "last.ckpt")
"""


@pytest.mark.slow
def test_resumed_processes_go_on_with_their_own_windows(make_dataset, tmp_path):
    folder = make_dataset(train=((30, 9), (24, 7), (18, 8), (21, 6), (16, 5)))
    (tmp_path / "train_to.py").write_text(TRAIN_TO)

    def train_to(name: str, steps: int, *checkpoint: str) -> list[list[str]]:
        words = [sys.executable, str(tmp_path / "train_to.py"), str(folder), str(tmp_path / name), str(steps)]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        subprocess.run([*words, *checkpoint], check=True, env=environment, capture_output=True, timeout=240)
        return [(tmp_path / name / f"rank_{rank}.txt").read_text().split() for rank in (0, 1)]

    straight = train_to("straight", 23)
    begun = train_to("begun", 10)
    resumed = train_to("resumed", 23, str(tmp_path / "begun" / "last.ckpt"))
    assert [len(seen) for seen in straight] == [23, 23]
    assert not set(straight[0]) & set(straight[1])
    assert [one + other for one, other in zip(begun, resumed, strict=True)] == straight


DIVERGE = """
import sys
from pathlib import Path

from lightning.pytorch import Trainer
from test_training import data_of, module_of
from torch import distributed

from nmpm.training import EmulatorModule
from nmpm.training.callbacks.divergence import DivergedError, DivergenceGuard


class OneRankDiverges(EmulatorModule):
    def training_step(self, batch, batch_idx):
        loss = super().training_step(batch, batch_idx)
        return loss * float("nan") if self.global_rank == 1 and self.global_step == 2 else loss


data = data_of(Path(sys.argv[1]))
module = module_of(data)
module.__class__ = OneRankDiverges
trainer = Trainer(
    accelerator="cpu", devices=2, strategy="ddp", max_steps=100, limit_val_batches=0, logger=False, log_every_n_steps=1,
    enable_checkpointing=False, enable_progress_bar=False, default_root_dir=sys.argv[2], callbacks=[DivergenceGuard()],
)
try:
    trainer.fit(module, datamodule=data)
except DivergedError as error:
    (Path(sys.argv[2]) / f"rank_{trainer.global_rank}.txt").write_text(str(error))
distributed.barrier()  # a process that ends closes its connections, which the other may still read from
distributed.destroy_process_group()
"""


@pytest.mark.slow
def test_all_processes_stop_where_the_loss_of_one_is_not_finite(make_dataset, tmp_path):
    (tmp_path / "diverge.py").write_text(DIVERGE)
    words = ["--standalone", "--nproc_per_node", "2", str(tmp_path / "diverge.py"), str(make_dataset()), str(tmp_path)]
    paths = [os.environ.get("PYTHONPATH", ""), str(Path(__file__).parent)]
    ended = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", *words],
        check=False,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert ended.returncode == 0, ended.stderr
    said = [(tmp_path / f"rank_{rank}.txt").read_text() for rank in (0, 1)]
    assert "at step 3 the loss of another rank is not finite" in said[0]
    assert "at step 3 the loss is nan" in said[1]
