"""A zoo with one small model, and a home of its own for each test."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import save
from scenes import box

from nmpm.decoders import Flip
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.processors import UNet
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
