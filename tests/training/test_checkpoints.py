"""Checkpoints are read without executing anything, and go on only with a model that suits them."""

import dataclasses
import functools
import os
from pathlib import Path

import pytest
import torch

from nmpm.decoders import Absolute
from nmpm.errors import ConfigError, DataError
from nmpm.optimizers import SOAP
from nmpm.processors import Identity
from nmpm.training import EmulatorModule
from nmpm.training.losses import PositionLoss
from nmpm.training.module import load_module
from nmpm.transfer import Nearest
from tests.conftest import make_dataset
from tests.trainings import TINY, data_of, module_of, trainer_of


@pytest.fixture(scope="module")
def begun(tmp_path_factory) -> Path:
    """A checkpoint of two steps of Adam, beside its dataset."""
    root = tmp_path_factory.mktemp("begun")
    data = data_of(make_dataset.__wrapped__(root)())
    trainer_of(root, 2).fit(module_of(data), data)
    return root / "last.ckpt"


def go_on(begun: Path, root: Path, steps: int = 4, **changes) -> None:
    data = data_of(begun.parent / "dataset")
    trainer_of(root, steps).fit(module_of(data, **changes), data, ckpt_path=begun, weights_only=True)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"processor": dataclasses.replace(TINY, width=8)}, r"model\.processor\.width = 4, not 8"),
        ({"processor": Identity()}, r"model\.processor = nmpm\.processors\.UNet, not nmpm\.processors\.Identity"),
        ({"transfer": Nearest()}, r"model\.transfer = nmpm\.transfer\.Linear, not nmpm\.transfer\.Nearest"),
        ({"decoder": Absolute()}, r"model\.decoder = nmpm\.decoders\.Residual, not nmpm\.decoders\.Absolute"),
        ({"cells": 16}, r"model\.cells = \[8, 8\], not \[16, 16\]"),
        ({"frames": 1, "unroll": 4}, r"model\.frames = 2, not 1"),
        ({"optimizer": SOAP}, r"model\.optimizer = torch\.optim\.Adam, not nmpm\.optimizers\.SOAP"),
    ],
    ids=lambda value: "",
)
def test_a_training_does_not_go_on_with_another_part(begun, tmp_path, changes, complaint):
    with pytest.raises(ConfigError, match=complaint) as refusal:
        go_on(begun, tmp_path, **changes)
    assert len(str(refusal.value)) < 300
    assert "Give the checkpoint's" in str(refusal.value)


def test_a_checkpoint_is_not_tested_with_another_part_or_on_other_scenes(begun, tmp_path):
    data, trainer = data_of(begun.parent / "dataset"), trainer_of(tmp_path, 4)
    with pytest.raises(ConfigError, match=r"width = 4, not 8"):
        trainer.test(module_of(data, processor=dataclasses.replace(TINY, width=8)), data, ckpt_path=begun)
    other = EmulatorModule(dataclasses.replace(data.scene, dt=0.01), cells=8, frames=2, processor=TINY)
    with pytest.raises(ConfigError, match=r"dt = 0\.0025, not 0\.01"):
        other.on_load_checkpoint(torch.load(begun, weights_only=True))
    # The optimizer does not matter for that.
    trainer.test(module_of(data, optimizer=SOAP), data, ckpt_path=begun, weights_only=True, verbose=False)


def test_a_training_goes_on_with_the_arguments_that_it_is_given(begun, tmp_path, caplog):
    slower = functools.partial(torch.optim.Adam, lr=1e-5, betas=(0.5, 0.9))
    changes = {
        "loss": PositionLoss(density_weight=0.5),
        "schedule": {"warmup": 1},
        "unroll": 1,
        "constraints": {"rest_speed": 0.1},
    }
    rate = torch.load(begun, weights_only=True)["optimizer_states"][0]["param_groups"][0]["initial_lr"]
    with caplog.at_level("INFO", "lightning.pytorch"):
        go_on(begun, tmp_path / "unchanged")
        assert "changed arguments" not in caplog.text
        go_on(begun, tmp_path / "more", optimizer=slower, **changes)
    (line,) = [record.getMessage() for record in caplog.records if "changed arguments" in record.getMessage()]
    assert line.startswith("Going on from step 2 with changed arguments: ")
    for change in (
        f"model.optimizer.lr = 1e-05 (was {rate})",
        "betas = (0.5, 0.9) (was (0.9, 0.999))",
        "model.loss.density_weight = 0.5 (was 4.0)",
        "schedule.warmup = 1 (was",
        "constraints.rest_speed = 0.1 (was",
    ):
        assert change in line
    ended = torch.load(tmp_path / "more" / "last.ckpt", weights_only=True)
    group = ended["optimizer_states"][0]["param_groups"][0]
    assert (group["initial_lr"], group["betas"]) == (1e-5, (0.5, 0.9))
    assert group["lr"] <= 1e-5
    assert ended["lr_schedulers"][0]["base_lrs"] == [1e-5]


def test_a_newer_checkpoint_is_refused(begun, tmp_path):
    torch.save(torch.load(begun, weights_only=True) | {"nmpm_format": 99}, tmp_path / "newer.ckpt")
    with pytest.raises(ConfigError, match=r"format 99.*use a newer one"):
        load_module(tmp_path / "newer.ckpt")


class Payload:
    def __reduce__(self):
        return (os.system, ("touch ran",))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        {"weights": torch.zeros(1)},
        {"state_dict": {}, "trap": Payload()},
        {"state_dict": {}},
        {"state_dict": {}, "hyper_parameters": {"scene": 7}},
        {"state_dict": {}, "hyper_parameters": {"unroll": "many"}},
        {"state_dict": [1, 2], "hyper_parameters": {}},
    ],
)
def test_other_files_are_refused_by_name_in_one_line_and_not_executed(content, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = Path("other.ckpt")
    path.write_bytes(content) if isinstance(content, bytes) else torch.save(content, path)
    with pytest.raises(DataError, match=r"other\.ckpt") as error:
        load_module(path)
    assert "\n" not in str(error.value)
    assert not Path("ran").exists()


def test_changed_and_truncated_weights_are_noticed(begun, tmp_path):
    content = torch.load(begun, weights_only=True)
    name = next(name for name in content["state_dict"] if name.endswith("weight"))
    content["state_dict"][name].view(-1)[0] += 1e-3
    torch.save(content, tmp_path / "changed.ckpt")
    with pytest.raises(DataError, match=r"changed\.ckpt is damaged: its weights are not those that were saved"):
        load_module(tmp_path / "changed.ckpt")
    whole = begun.read_bytes()
    (tmp_path / "truncated.ckpt").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"truncated\.ckpt cannot be read as a checkpoint"):
        load_module(tmp_path / "truncated.ckpt")
