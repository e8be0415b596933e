"""A checkpoint meets a model with other parts: one line names the part and both values."""

import dataclasses
import functools
from pathlib import Path

import pytest
import torch
from test_training import TINY, data_of, module_of, trainer_of

from nmpm.decoders import Absolute
from nmpm.errors import ConfigError
from nmpm.optimizers import SOAP
from nmpm.processors import Identity
from nmpm.training import EmulatorModule
from nmpm.training.checkpoints import load_module
from nmpm.transfer import Nearest

GOLDEN = Path(__file__).parents[1] / "golden" / "checkpoint.ckpt"


@pytest.fixture
def begun(make_dataset, tmp_path) -> Path:
    """A checkpoint of two steps of Adam."""
    data = data_of(make_dataset())
    trainer_of(tmp_path / "run", 2).fit(module_of(data), data)
    return tmp_path / "run" / "last.ckpt"


CHANGES = [
    ({"processor": dataclasses.replace(TINY, width=8)}, r"model\.processor\.width = 4, not 8"),
    ({"processor": Identity()}, r"model\.processor = nmpm\.processors\.UNet, not nmpm\.processors\.Identity"),
    ({"transfer": Nearest()}, r"model\.transfer = nmpm\.transfer\.Linear, not nmpm\.transfer\.Nearest"),
    ({"decoder": Absolute()}, r"model\.decoder = nmpm\.decoders\.Residual, not nmpm\.decoders\.Absolute"),
    ({"cells": 16}, r"model\.cells = \[8, 8\], not \[16, 16\]"),
    ({"frames": 1, "unroll": 4}, r"model\.frames = 2, not 1"),
    ({"optimizer": SOAP}, r"model\.optimizer = torch\.optim\.Adam, not nmpm\.optimizers\.SOAP"),
]


@pytest.mark.parametrize(("changes", "complaint"), CHANGES, ids=lambda value: "")
def test_a_training_does_not_go_on_with_another_part(begun, tmp_path, changes, complaint):
    data = data_of(tmp_path / "dataset")
    with pytest.raises(ConfigError, match=complaint) as refusal:
        trainer_of(tmp_path / "more", 4).fit(module_of(data, **changes), data, ckpt_path=begun, weights_only=True)
    assert len(str(refusal.value)) < 300
    assert "Give the checkpoint's" in str(refusal.value)


def test_a_checkpoint_is_not_tested_with_another_part_or_on_other_scenes(begun, tmp_path):
    data, trainer = data_of(tmp_path / "dataset"), trainer_of(tmp_path / "more", 4)
    with pytest.raises(ConfigError, match=r"width = 4, not 8"):
        trainer.test(module_of(data, processor=dataclasses.replace(TINY, width=8)), data, ckpt_path=begun)
    other = EmulatorModule(dataclasses.replace(data.scene, dt=0.01), cells=8, frames=2, processor=TINY)
    with pytest.raises(ConfigError, match=r"dt = 0\.0025, not 0\.01"):
        other.on_load_checkpoint(torch.load(begun, weights_only=True))
    # The optimizer does not matter for that.
    trainer.test(module_of(data, optimizer=SOAP), data, ckpt_path=begun, weights_only=True, verbose=False)


def test_what_may_change_does(begun, tmp_path):
    data = data_of(tmp_path / "dataset")
    changed = module_of(data, grid_noise=0.0, unroll=1, constraints={"rest_speed": 0.1})
    trainer = trainer_of(tmp_path / "more", 3)
    trainer.fit(changed, data, ckpt_path=begun, weights_only=True)
    assert trainer.global_step == 3


def test_a_training_goes_on_with_the_arguments_that_it_is_given(begun, tmp_path, caplog):
    data = data_of(tmp_path / "dataset")
    slower = functools.partial(torch.optim.Adam, lr=1e-5, betas=(0.5, 0.9))
    changed = module_of(data, optimizer=slower, density_weight=0.5, schedule={"warmup": 1})
    was = torch.load(begun, weights_only=True)
    with caplog.at_level("INFO", "lightning.pytorch"):
        trainer_of(tmp_path / "more", 4).fit(changed, data, ckpt_path=begun, weights_only=True)
    (line,) = [record.getMessage() for record in caplog.records if "changed arguments" in record.getMessage()]
    assert line.startswith("Going on from step 2 with changed arguments: ")
    rate = was["optimizer_states"][0]["param_groups"][0]["initial_lr"]
    assert f"model.optimizer.lr = 1e-05 (was {rate})" in line
    for found in (
        "betas = (0.5, 0.9) (was (0.9, 0.999))",
        "density_weight = 0.5 (was 4.0)",
        "schedule.warmup = 1 (was",
    ):
        assert found in line
    ended = torch.load(tmp_path / "more" / "last.ckpt", weights_only=True)
    group = ended["optimizer_states"][0]["param_groups"][0]
    assert (group["initial_lr"], group["betas"]) == (1e-5, (0.5, 0.9))
    assert group["lr"] <= 1e-5
    assert ended["lr_schedulers"][0]["base_lrs"] == [1e-5]


def test_a_training_that_goes_on_unchanged_says_nothing(begun, tmp_path, caplog):
    data = data_of(tmp_path / "dataset")
    with caplog.at_level("INFO", "lightning.pytorch"):
        trainer_of(tmp_path / "more", 4).fit(module_of(data), data, ckpt_path=begun, weights_only=True)
    assert "changed arguments" not in caplog.text


def test_arguments_that_an_older_checkpoint_does_not_have_are_told(begun, tmp_path):
    checkpoint = torch.load(begun, weights_only=True)
    del checkpoint["hyper_parameters"]["gradient_discount"]
    changed = module_of(data_of(tmp_path / "dataset")).adopt_arguments(checkpoint)
    assert changed == ["model.gradient_discount = 0.5 (was not an option yet)"]


def test_checkpoints_without_the_name_of_their_optimizer_are_compared_by_its_arguments(begun, tmp_path):
    old = torch.load(begun, weights_only=True)
    del old["nmpm_optimizer"]
    data = data_of(tmp_path / "dataset")
    with pytest.raises(ConfigError, match=r"model\.optimizer = another optimizer, with amsgrad, betas"):
        module_of(data, optimizer=SOAP).adopt_arguments(old)
    module_of(data, optimizer=functools.partial(torch.optim.Adam, lr=1e-4)).adopt_arguments(old)


def test_a_checkpoint_of_version_0_1_0_goes_on_loading_and_a_newer_one_is_refused(tmp_path):
    module = load_module(GOLDEN)
    content = torch.load(GOLDEN, weights_only=True)
    module.on_load_checkpoint(content)
    torch.save(content | {"nmpm_format": 99}, tmp_path / "newer.ckpt")
    with pytest.raises(ConfigError, match=r"format 99.*pip install --upgrade nmpm"):
        load_module(tmp_path / "newer.ckpt")
