"""One journey: train, add, fine-tune by the name, add, load and export."""

import json

import onnxruntime
import pytest
import torch

from nmpm.cli import main
from nmpm.zoo import Zoo

OPTIONS = {
    "model.unroll": 1, "model.cells": 16, "model.processor.width": 4, "model.processor.depth": 1, "model.mirror": [],
    "model.schedule.warmup": 1, "data.batch_size": 2, "trainer.precision": "32-true", "trainer.max_steps": 4,
    "trainer.val_check_interval": 4, "trainer.accelerator": "cpu", "trainer.devices": 1,
    "trainer.enable_progress_bar": False, "trainer.log_every_n_steps": 1,
}  # fmt: skip


@pytest.fixture
def fit(make_dataset, tmp_path, monkeypatch):
    """Trains for a few steps in a folder, with further words of `nmpm fit`."""
    monkeypatch.chdir(tmp_path)
    sizes = ((40, 9),) * 2
    data = make_dataset(train=sizes, valid=sizes, test=sizes)

    def train(folder: str, *more: str) -> None:
        stated = OPTIONS | {"data.path": str(data), "trainer.default_root_dir": folder}
        words = [w for k, v in stated.items() for w in (f"--{k}", v if isinstance(v, str) else json.dumps(v))]
        assert main(["fit", "--config", "waterdrop.yaml", *words, *more]) == 0

    return train


@pytest.mark.slow
def test_a_fine_tuned_model_is_added_loaded_and_exported(fit, home, tmp_path, capsys):
    fit("runs/first")
    assert main(["zoo", "add", "runs/first", "first", "--about", "Made up."]) == 0
    fit("runs/tuned", "--start_from", "first", "--model.optimizer.init_args.lr", "0.0001")
    assert main(["zoo", "add", "runs/tuned", "first/tuned"]) == 0
    assert Zoo.variants("first") == ["first", "first/tuned"]
    first, tuned = Zoo.load("first"), Zoo.load("first", variant="tuned")
    weights = dict(tuned.emulator.processor.named_parameters())
    apart = [float((value - weights[name]).abs().max()) for name, value in first.emulator.processor.named_parameters()]
    assert 0 < max(apart) < 0.1  # moved, and not far from where it started
    assert torch.equal(tuned.emulator.input_std, first.emulator.input_std)
    state = tuned.example(count=50)
    assert torch.equal(tuned.rollout(state, 8), Zoo.load(home / "zoo" / "first" / "tuned").rollout(state, 8))
    assert main(["zoo", "card", "first/tuned"]) == 0
    card = capsys.readouterr().out
    assert "# first/tuned" in card
    assert "rollouts   Numba kernels" in card
    assert main(["export", "first/tuned", "--processor", "--out", "network.onnx"]) == 0
    assert onnxruntime.InferenceSession(tmp_path / "network.onnx").get_inputs()
