"""Several processes, accumulated gradients, changed numbers of processes: all train as one with all of the batch."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from itertools import chain, islice
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch import Trainer
from torch.utils.data import DataLoader

from nmpm.cli import main
from nmpm.data.format import Split
from nmpm.emulator.calibration import calibrate
from nmpm.training import EmulatorModule
from nmpm.training.callbacks.outputs import PredictionWriter
from tests.conftest import make_dataset
from tests.made_up import made_up_trajectory
from tests.trainings import data_of, fingerprints, train

SIZES = ((30, 9), (24, 7), (18, 8), (21, 6), (16, 5))
QUIET = {"position_noise": 0.0, "grid_noise": 0.0, "mirror": (), "jitter": 0.0}
BATCH = {"batch_size": 4, "buffer_size": 5, "passes": 1.0}  # with all trajectories, 84 windows, in memory
HALF = BATCH | {"batch_size": 2}
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
PATIENCE = 270
"""Seconds until a process that does not end fails its test, a little before pytest would end all of them."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_dataset.__wrapped__(tmp_path_factory.mktemp("data"))(train=SIZES, valid=SIZES, test=SIZES)


@pytest.fixture(scope="module")
def two(folder, tmp_path_factory) -> dict[str, list[dict]]:
    """Records of both ranks, by the name of the training, and the folder of the checkpoints."""
    root = tmp_path_factory.mktemp("two")
    train(folder, root / "alone.ckpt", max_steps=5, data=BATCH | {"batch_size": 3})
    runs = {
        "all": {"max_steps": 14, "data": {"batch_size": 2, "emphasis": 0.5}, "average": True},
        "soap": {"max_steps": 24, "data": {"batch_size": 2}, "soap": True},
        "members": {"max_steps": 4, "data": {"batch_size": 2}, "model": {"members": 2}},
        "begun": {"max_steps": 6, "data": HALF},
        "resumed": {"max_steps": 10, "data": HALF, "ckpt_path": str(root / "alone.ckpt")},
        "accumulated": {"max_steps": 7, "accumulate_grad_batches": 2, "data": HALF},
        "clock": {"max_steps": 10**6, "max_time": "00:00:00:02", "data": {"batch_size": 2}},
    }
    (root / "runs.json").write_text(json.dumps({name: run | {"folder": str(folder)} for name, run in runs.items()}))
    torchrun(Path(__file__).parents[1] / "trainings.py", root / "runs.json")
    records = {name: [json.loads((root / f"{name}-{rank}.json").read_text()) for rank in (0, 1)] for name in runs}
    return records | {"root": root}


def torchrun(*words: object) -> None:
    """Run a script in two processes."""
    options = ["--standalone", "--nproc_per_node", "2", *map(str, words)]
    launcher = subprocess.Popen(
        [sys.executable, "-m", "torch.distributed.run", *options],
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert launcher.wait(timeout=PATIENCE) == 0
    finally:
        launcher.terminate()  # it ends the processes that it started


def planned(folder: Path, count: int) -> list[str]:
    """The first windows that a training sees, in order."""
    batches = iter(data_of(folder, **BATCH | {"batch_size": 1}).train_dataloader())
    return [window for batch in islice(batches, count) for window in fingerprints(batch)]


def together(processes: list[dict]) -> list[str]:
    """The windows that processes saw, in the order of the plan."""
    return list(chain(*(one + other for one, other in zip(*(rank["windows"] for rank in processes), strict=True))))


@pytest.mark.slow
def test_two_processes_have_the_loss_curve_of_one_with_twice_the_batch(folder, two, tmp_path):
    """With gradients discounted from bundle to bundle, Adam, and weights that are averaged in the end; also SOAP."""
    one = train(folder, tmp_path / "one.ckpt", max_steps=14, data={"emphasis": 0.5}, average=True)
    assert together(two["all"]) == list(chain(*one["windows"]))
    for record in two["all"]:
        assert record["losses"] == pytest.approx(one["losses"], rel=1e-5)
        assert record["weights"] == pytest.approx(one["weights"], rel=1e-5, abs=1e-6)
        assert record["seeds"] == one["seeds"]
    soap = train(folder, tmp_path / "soap.ckpt", max_steps=24, soap=True)
    assert two["soap"][0]["losses"] == pytest.approx(soap["losses"], rel=1e-3)
    members = train(folder, tmp_path / "members.ckpt", max_steps=4, model={"members": 2})
    assert two["members"][0]["losses"] == pytest.approx(members["losses"], rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["all", "clock", "accumulated", "soap", "members"])
def test_processes_stay_together(two, name):
    one, other = two[name]
    for key in ("weights", "rates", "losses"):
        assert one[key] == other[key]


@pytest.mark.slow
def test_trainings_go_on_with_other_numbers_of_processes(folder, two, tmp_path):
    assert together(two["resumed"]) == planned(folder, 5 * 3 + 5 * 4)[5 * 3 :]
    begun, options = two["root"] / "begun.ckpt", BATCH | {"batch_size": 3}
    more = train(folder, tmp_path / "more.ckpt", ckpt_path=begun, max_steps=16, data=options)
    seen = together(two["begun"]) + list(chain(*more["windows"]))
    assert seen == planned(folder, 6 * 4 + 10 * 3)
    assert len(set(seen)) == len(seen)
    straight = train(folder, tmp_path / "straight.ckpt", max_steps=9, data=BATCH)
    resumed = train(folder, tmp_path / "resumed.ckpt", ckpt_path=begun, max_steps=9, data=BATCH)
    assert resumed["windows"] == straight["windows"][6:]
    assert resumed["losses"] == pytest.approx(straight["losses"][6:], rel=1e-5)


def test_accumulated_batches_equal_a_larger_one_where_scenes_have_as_many_particles(make_dataset, tmp_path):
    even = make_dataset(train=[(frames, 7) for frames, _ in SIZES])
    # Calibrated beforehand: by the first batches, that is by fewer windows, the statistics would be others.
    start = {"max_steps": 5, "model": QUIET, "calibrated": True}
    whole = train(even, tmp_path / "whole.ckpt", **start, data=BATCH)
    parts = train(even, tmp_path / "parts.ckpt", **start, accumulate_grad_batches=2, data=HALF)
    assert list(chain(*parts["windows"])) == list(chain(*whole["windows"]))
    pairs = zip(parts["losses"][::2], parts["losses"][1::2], strict=True)
    assert [sum(pair) / 2 for pair in pairs] == pytest.approx(whole["losses"], rel=1e-5)
    assert parts["rates"][1::2] == whole["rates"]  # the schedule counts optimizer steps
    assert parts["weights"] == pytest.approx(whole["weights"], rel=1e-4, abs=1e-5)
    assert len(set(parts["seeds"])) == 10  # every batch has noise of its own


def test_calibration_of_parts_is_that_of_the_whole(folder, monkeypatch):
    data = data_of(folder, **BATCH)
    windows = list(islice(data.train_dataloader(), 4))
    whole, parted = (EmulatorModule(data.scene, cells=8, frames=2).emulator for _ in range(2))
    calibrate(whole, windows)
    sent = []  # what two ranks would exchange
    monkeypatch.setattr("nmpm.emulator.calibration.all_gather", lambda value: sent.append(value) or [value])
    for part in (windows[:1], windows[1:]):
        calibrate(parted, part)
    received = iter([[sent[0], sent[2]], [sent[1], sent[3]]])
    monkeypatch.setattr("nmpm.emulator.calibration.all_gather", lambda _: next(received))
    calibrate(parted, windows[:1])
    for name, value in whole.named_buffers():
        torch.testing.assert_close(dict(parted.named_buffers())[name], value)


def test_predictions_are_in_the_order_of_the_split_or_of_a_loader_of_the_users(folder, tmp_path, monkeypatch):
    data = data_of(folder, **BATCH)
    windows = list(data.test_dataloader())
    module = EmulatorModule(data.scene, cells=8, frames=2)
    calibrate(module.emulator, list(islice(data.train_dataloader(), 1)))
    options = {"logger": False, "enable_progress_bar": False, "accelerator": "cpu"}
    trainer = Trainer(default_root_dir=tmp_path, callbacks=[PredictionWriter()], **options)
    trainer.predict(module, DataLoader(windows[::-1], batch_size=None))
    written = Split(tmp_path / "predictions.h5")
    wanted = [int(real.sum()) for window in windows[::-1] for real in window.mask]
    assert [written.particles(index) for index in range(len(written))] == wanted
    made = [made_up_trajectory(5, particles) for particles in (3, 4, 5)]
    by_rank = [{2: made[2], 0: made[0]}, {1: made[1]}]
    monkeypatch.setattr("nmpm.training.callbacks.outputs.gather_to_rank0", lambda _: by_rank)
    PredictionWriter().on_predict_end(SimpleNamespace(is_global_zero=True, default_root_dir=tmp_path), None)
    written = Split(tmp_path / "predictions.h5")
    assert [written.particles(index) for index in range(len(written))] == [3, 4, 5]


COMMON = [
    *("--config", "waterdrop.yaml", "--model.unroll", "1", "--model.processor.width", "4", "--data.batch_size", "2"),
    *("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false", "--trainer.precision", "32-true"),
]


def nmpm(command: str, *words: str, devices: int) -> None:
    spread = ["--trainer.devices", str(devices), "--trainer.strategy", "ddp" if devices > 1 else "auto"]
    called = [sys.executable, "-m", "nmpm", command, *COMMON, *words, *spread]
    subprocess.run(called, check=True, env=ENVIRONMENT, stdout=subprocess.DEVNULL, timeout=PATIENCE)


@pytest.fixture(scope="module")
def compiled(folder, tmp_path_factory) -> None:
    """The kernels of `COMMON`, compiled before processes that are waited for: on a busy machine it takes minutes."""
    root = ["--trainer.default_root_dir", str(tmp_path_factory.mktemp("compiled"))]
    few = ["--trainer.max_steps", "1", "--trainer.val_check_interval", "1"]
    assert main(["fit", *COMMON, "--data.path", str(folder), *few, *root]) == 0


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("sizes", [((30, 9), (40, 7), (30, 8)), ((40, 9),)])  # the second rank may have none
def test_two_processes_measure_what_one_measures(make_dataset, tmp_path, sizes):
    data = ["--data.path", str(make_dataset(train=sizes, valid=sizes, test=sizes))]
    two, one, short = tmp_path / "two", tmp_path / "one", ["--trainer.max_steps", "3"]
    nmpm("fit", *data, *short, "--trainer.val_check_interval", "3", "--trainer.default_root_dir", str(two), devices=2)
    best = ["--ckpt_path", str(two / "checkpoints" / "best.ckpt")]
    nmpm("test", *data, *best, "--trainer.default_root_dir", str(one), devices=1)
    shared, alone = (json.loads((root / "report.json").read_text()) for root in (two, one))
    assert shared["training"]["devices"] == 2
    assert shared["test"] == pytest.approx(alone["test"], rel=1e-5)
    counted, rows = ([row["mse"] for row in report["per_trajectory"]["model"]] for report in (shared, alone))
    assert counted == pytest.approx(rows, rel=1e-5)  # in the order of the split, of which batches take equal lengths
    nmpm("predict", *data, *best, "--trainer.default_root_dir", str(two), devices=2)
    predicted = Split(two / "predictions.h5")
    assert [predicted.particles(index) for index in range(len(predicted))] == [particles for _, particles in sizes]


DIVERGE = """
import sys
from pathlib import Path

import torch
from lightning.pytorch import Trainer
from torch import distributed

from nmpm.training import EmulatorModule
from nmpm.training.callbacks.divergence import DivergedError, DivergenceGuard
from tests.trainings import data_of, module_of


class OneRankDiverges(EmulatorModule):
    def training_step(self, batch, batch_idx):
        loss = super().training_step(batch, batch_idx)
        return loss * (float("nan") if self.global_rank == 1 and self.global_step == 3 else 1.0)


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
def test_all_processes_stop_where_the_loss_of_one_is_not_finite(folder, tmp_path):
    (tmp_path / "diverge.py").write_text(DIVERGE)
    torchrun(tmp_path / "diverge.py", folder, tmp_path)
    errors = [(tmp_path / f"rank_{rank}.txt").read_text() for rank in (0, 1)]
    assert "of another rank" in errors[0]
    assert all("The training has diverged" in error for error in errors)


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(
    ("end", "how"),
    [
        ("SIGINT to both", ""),
        ("SIGTERM to rank 0", ""),
        ("SIGKILL to rank 0", r"rank 0 \(process {}\) has ended: "),
        ("SIGKILL to rank 1", r"rank 1 \(process {}\) was killed by SIGKILL: "),
    ],
)
def test_an_ended_process_stops_the_others_and_the_run_goes_on_with_fewer(
    make_dataset, tmp_path, monkeypatch, end, how
):
    monkeypatch.chdir(tmp_path)
    sizes = ((40, 9),) * 2
    data = ["--data.path", str(make_dataset(train=sizes, valid=sizes, test=sizes))]
    words = [*COMMON, *data, "--resume.every_n_train_steps", "1", "--trainer.default_root_dir", "run"]
    long = ["--trainer.max_steps", "100000", "--trainer.val_check_interval", "100000"]
    spread = ["--trainer.devices", "2", "--trainer.strategy", "ddp"]
    called = [sys.executable, "-m", "nmpm", "fit", *words, *long, *spread]
    with Path("errors").open("w") as errors:
        first = subprocess.Popen(
            called, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True
        )
    last, deadline = Path("run/checkpoints/last.ckpt"), time.monotonic() + PATIENCE
    try:
        while not last.exists() and time.monotonic() < deadline:
            assert first.poll() is None, "it ended too soon"
            time.sleep(0.05)
        (second,) = nmpm_children(first.pid)
        killed = second if end.endswith("1") else first.pid
        (os.killpg if end.endswith("both") else os.kill)(killed, signal.Signals[end.split()[0]])
        assert first.wait(timeout=60) != 0
        while is_running(second) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not is_running(second)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(first.pid, signal.SIGKILL)
    said = Path("errors").read_text().strip()  # after a warning about the made-up data
    (found,) = re.finditer(r"^nmpm fit: (.*)\. Go on with: nmpm (fit --resume run)$", said, re.MULTILINE)
    assert re.match(how.format(killed), found[1]), said
    steps = torch.load(last, weights_only=True)["global_step"]
    alone = ["--trainer.devices", "1", "--trainer.strategy", "auto", "--trainer.val_check_interval", "1"]
    assert main([*found[2].split(), *alone, "--trainer.max_steps", str(steps + 2)]) == 0
    assert json.loads(Path("run/report.json").read_text())["training"]["steps"] == steps + 2


def nmpm_children(pid: int) -> list[int]:
    """Child processes that run nmpm."""
    children = [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return list(filter(is_running, children))


def is_running(pid: int) -> bool:
    """Whether a process runs nmpm."""
    try:
        return b"nmpm" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
