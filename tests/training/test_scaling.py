"""Several processes, accumulated gradients, changed numbers of processes: all train as one with all of the batch."""

import json
import os
import subprocess
import sys
from itertools import chain, islice
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch import Trainer
from torch.utils.data import DataLoader
from trainings import data_of, fingerprints, train

from nmpm.data.format import Split, write_metadata, write_split
from nmpm.emulator.calibration import calibrate
from nmpm.training import EmulatorModule
from nmpm.training.callbacks.prediction_writer import PredictionWriter
from tests.made_up import made_up_metadata, made_up_trajectory

SIZES = ((30, 9), (24, 7), (18, 8), (21, 6), (16, 5))
QUIET = {"position_noise": 0.0, "grid_noise": 0.0, "mirror": (), "jitter": 0.0}
HELD = {"buffer_size": 5}  # all trajectories, 84 windows


def dataset(folder: Path, sizes=SIZES) -> Path:
    for name in ("train", "valid", "test"):
        write_split(folder / f"{name}.h5", [made_up_trajectory(*size, seed=i) for i, size in enumerate(sizes)])
    write_metadata(folder, made_up_metadata())
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def two(folder, tmp_path_factory) -> dict[str, list[dict]]:
    """Records of both ranks, by the name of the training, and the folder of the checkpoints."""
    root = tmp_path_factory.mktemp("two")
    train(folder, root / "alone.ckpt", max_steps=5, data={**HELD, "batch_size": 3})
    runs = {
        "all": {"max_steps": 14, "data": {"batch_size": 2, "emphasis": 0.5}},
        "soap": {"max_steps": 24, "data": {"batch_size": 2}, "soap": True},
        "begun": {"max_steps": 6, "data": {**HELD, "batch_size": 2}},
        "resumed": {"max_steps": 10, "data": {**HELD, "batch_size": 2}, "ckpt_path": str(root / "alone.ckpt")},
        "accumulated": {"max_steps": 7, "accumulate_grad_batches": 2, "data": {**HELD, "batch_size": 2}},
        "clock": {"max_steps": 10**6, "max_time": "00:00:00:02", "data": {"batch_size": 2}},
    }
    (root / "runs.json").write_text(json.dumps({name: run | {"folder": str(folder)} for name, run in runs.items()}))
    words = ["--standalone", "--nproc_per_node", "2", str(Path(__file__).parents[1] / "trainings.py")]
    launcher = subprocess.Popen(
        [sys.executable, "-m", "torch.distributed.run", *words, str(root / "runs.json")],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert launcher.wait(timeout=280) == 0
    finally:
        launcher.terminate()  # it ends the processes that it started
    records = {name: [json.loads((root / f"{name}-{rank}.json").read_text()) for rank in (0, 1)] for name in runs}
    return records | {"root": root}


def row(folder: Path, count: int) -> list[str]:
    """The first windows that a training sees, in order."""
    batches = iter(data_of(folder, **HELD, batch_size=1).train_dataloader())
    return [window for batch in islice(batches, count) for window in fingerprints(batch)]


def together(processes: list[dict]) -> list[str]:
    """The windows that processes saw, in the order of the plan."""
    return list(
        chain(*(mine + other for mine, other in zip(*(record["windows"] for record in processes), strict=True)))
    )


@pytest.mark.slow
def test_two_processes_have_the_loss_curve_of_one_with_twice_the_batch(folder, two, tmp_path):
    one = train(folder, tmp_path / "one.ckpt", max_steps=14, data={"emphasis": 0.5})
    assert together(two["all"]) == list(chain(*one["windows"]))
    for record in two["all"]:
        assert record["losses"] == pytest.approx(one["losses"], rel=1e-5)
        assert record["weights"] == pytest.approx(one["weights"], rel=1e-5, abs=1e-6)
        assert record["seeds"] == one["seeds"]


@pytest.mark.slow
def test_soap_trains_two_processes_as_one(folder, two, tmp_path):
    one = train(folder, tmp_path / "one.ckpt", max_steps=24, soap=True)
    assert two["soap"][0]["losses"] == pytest.approx(one["losses"], rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["all", "clock", "accumulated", "soap"])
def test_processes_stay_together(two, name):
    one, other = two[name]
    assert one["weights"] == other["weights"]
    assert one["rates"] == other["rates"]
    assert one["losses"] == other["losses"]


@pytest.mark.slow
def test_two_processes_are_gone_on_with_by_one(folder, two, tmp_path):
    begun = two["root"] / "begun.ckpt"
    more = train(folder, tmp_path / "more.ckpt", ckpt_path=begun, max_steps=16, data={**HELD, "batch_size": 3})
    seen = together(two["begun"]) + list(chain(*more["windows"]))
    assert seen == row(folder, 6 * 4 + 10 * 3)
    assert len(set(seen)) == len(seen)
    # and by another number once more
    last = train(folder, tmp_path / "last", ckpt_path=tmp_path / "more.ckpt", max_steps=18, data={**HELD})
    assert seen + list(chain(*last["windows"])) == row(folder, 6 * 4 + 10 * 3 + 2 * 4)


@pytest.mark.slow
def test_two_processes_go_on_with_one(folder, two):
    assert together(two["resumed"]) == row(folder, 5 * 3 + 5 * 4)[5 * 3 :]


@pytest.mark.slow
def test_one_goes_on_just_as_two_would_have_when_the_whole_batch_stays(folder, two, tmp_path):
    straight = train(folder, tmp_path / "straight.ckpt", max_steps=9, data=HELD)
    more = train(folder, tmp_path / "more.ckpt", ckpt_path=two["root"] / "begun.ckpt", max_steps=9, data=HELD)
    assert more["windows"] == straight["windows"][6:]
    assert more["losses"] == pytest.approx(straight["losses"][6:], rel=1e-5)


class TestAccumulation:
    def test_equals_a_larger_batch_where_scenes_have_as_many_particles(self, tmp_path):
        even = dataset(tmp_path / "even", [(frames, 7) for frames, _ in SIZES])
        # Calibrated beforehand: by the first batches, that is by fewer windows, the statistics would be others.
        start = {"max_steps": 8, "model": QUIET, "calibrated": True}
        whole = train(even, tmp_path / "whole.ckpt", **start, data=HELD)
        parts = train(even, tmp_path / "parts.ckpt", **start, accumulate_grad_batches=2, data={**HELD, "batch_size": 2})
        assert list(chain(*parts["windows"])) == list(chain(*whole["windows"]))
        losses = [
            (first + second) / 2 for first, second in zip(parts["losses"][::2], parts["losses"][1::2], strict=True)
        ]
        assert losses == pytest.approx(whole["losses"], rel=1e-5)
        assert parts["rates"][1::2] == whole["rates"]  # the schedule counts optimizer steps
        assert parts["weights"] == pytest.approx(whole["weights"], rel=1e-4, abs=1e-5)

    def test_every_batch_has_noise_of_its_own(self, folder, tmp_path):
        record = train(folder, tmp_path / "last.ckpt", max_steps=3, accumulate_grad_batches=2)
        assert len(set(record["seeds"])) == 6


def test_calibration_of_parts_is_that_of_the_whole(folder, monkeypatch):
    data = data_of(folder)
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


def test_one_process_writes_the_predictions_of_all_in_order(monkeypatch, tmp_path):
    made = [made_up_trajectory(5, particles) for particles in (3, 4, 5)]
    monkeypatch.setattr(
        "nmpm.training.callbacks.prediction_writer.gather_to_rank0",
        lambda mine: [{2: made[2], 0: made[0]}, {1: made[1]}],
    )
    trainer = SimpleNamespace(is_global_zero=True, default_root_dir=tmp_path)
    PredictionWriter().on_predict_end(trainer, None)
    written = Split(tmp_path / "predictions.h5")
    assert [written.read(index).position.shape[1] for index in range(len(written))] == [3, 4, 5]


def test_predictions_of_another_loader_have_its_order(folder, tmp_path):
    data = data_of(folder)
    windows = list(data.test_dataloader())
    module = EmulatorModule(data.scene, cells=8, frames=2)
    calibrate(module.emulator, list(islice(data.train_dataloader(), 1)))
    options = {"logger": False, "enable_progress_bar": False, "accelerator": "cpu"}
    trainer = Trainer(default_root_dir=tmp_path, callbacks=[PredictionWriter()], **options)
    trainer.predict(module, DataLoader(windows[::-1], batch_size=None))
    written = Split(tmp_path / "predictions.h5")
    wanted = [int(real.sum()) for window in windows[::-1] for real in window.mask]
    assert [written.particles(index) for index in range(len(written))] == wanted
