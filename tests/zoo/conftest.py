"""A zoo with one small model, and a home of its own for each test."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import save
from scenes import box

from nmpm._support.shipped import shipped_folder
from nmpm.decoders import Flip
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.processors import UNet
from nmpm.training.module import EmulatorModule
from nmpm.transfer import Quadratic


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def small() -> Emulator:
    torch.manual_seed(0)
    emulator = EmulatorRecipe(box(), 16, 4, Quadratic(), UNet(width=4, depth=1, perceptron=(4,)), Flip()).build()
    emulator.input_std.fill_(2.0)
    return emulator.eval()


@pytest.fixture
def write_entry() -> Callable[..., Path]:
    """Writes an emulator, or other bytes in place of its weights, as an entry."""

    def write(folder: Path, emulator: Emulator, weights: bytes | None = None, **card: object) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        if weights is None:
            weights = save({name: value.contiguous() for name, value in emulator.state_dict().items()})
        (folder / "model.safetensors").write_bytes(weights)
        (folder / "config.yaml").write_text(yaml.safe_dump(emulator.recipe.to_dict()))
        facts = {"format": 1, "name": folder.name, "dataset": "made up"}
        facts |= {"sha256": hashlib.sha256(weights).hexdigest()}
        (folder / "card.yaml").write_text(yaml.safe_dump(facts | {"test": {"mse": 0.1}} | card))
        return folder

    return write


@pytest.fixture
def root(tmp_path, small, write_entry) -> Path:
    write_entry(tmp_path / "zoo" / "small", small)
    return tmp_path / "zoo"


@pytest.fixture
def run(tmp_path, small) -> Path:
    """The folder that a training leaves."""
    module = EmulatorModule.of(small, unroll=3)
    content = {"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams), "nmpm_format": 1}
    folder = tmp_path / "runs" / "mine"
    (folder / "checkpoints").mkdir(parents=True)
    for name in ("best", "last"):
        torch.save(content, folder / "checkpoints" / f"{name}.ckpt")
    training = {"steps": 7, "horizon": 99, "seconds": 90.0, "precision": "32-true", "hardware": "a CPU", "devices": 1}
    report = {
        "dataset": "goop, simulated by nmpm",
        "test": {"mse": 0.00055842194, "mse@100": 3.4241e-05, "still/mse": 0.0535708, "free_fall/mse": 0.03128},
        "per_trajectory": {"model": [{"mse": 0.1, "mse@100": 0.05}, {"mse": 0.2}]},
        "training": training | {"parameters": 1234},
        "curve": [[45.0, 35, 0.4], [90.0, 70, 0.3]],
        "versions": {"nmpm": "0"},
    }
    (folder / "report.json").write_text(json.dumps(report))
    return folder


@pytest.fixture
def goop(tmp_path) -> Path:
    """A copy of a complete entry, without its variants."""
    folder = tmp_path / "copy" / "goop"
    folder.mkdir(parents=True)
    for path in (shipped_folder("zoo") / "goop").glob("*.*"):
        (folder / path.name).write_bytes(path.read_bytes())
    return folder
