"""Files that earlier versions wrote load, and give the same rollouts."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from nmpm import Particles, Zoo
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator.model import Emulator
from nmpm.emulator.rollouts import rollout
from nmpm.training.checkpoints import load_module

GOLDEN = Path(__file__).parent / "golden"
HELD = 2e-3  # domain lengths: how rollouts are held to their energy was changed on purpose


def check_rollout(emulator: Emulator, path: Path) -> None:
    content = np.load(path)
    names = {field.name for field in dataclasses.fields(Particles)} & set(content)
    state = Particles(**{name: torch.from_numpy(content[name]) for name in names})
    held = rollout(emulator, state, 32)[:, 7::8]
    free = rollout(emulator.unconstrained(), state, 32)[:, 7::8]
    torch.testing.assert_close(free, torch.from_numpy(content["free"]), atol=2e-5, rtol=0)
    torch.testing.assert_close(held, torch.from_numpy(content["held"]), atol=HELD, rtol=0)


@pytest.mark.parametrize("name", ["goop", "waterdrop", "waterramps"])
def test_a_zoo_entry_of_version_0_1_loads_and_rolls_out_the_same(name):
    model = Zoo.load(name, root=GOLDEN / "zoo")
    check_rollout(model.emulator, GOLDEN / "zoo" / name / "rollout.npz")


def test_a_checkpoint_of_version_0_1_loads_and_rolls_out_the_same():
    module = load_module(GOLDEN / "checkpoint.ckpt")
    check_rollout(module.emulator.eval(), GOLDEN / "checkpoint.npz")


def test_a_dataset_of_version_0_1_gives_the_same_scene():
    data = TrajectoryDataModule(path=str(GOLDEN / "dataset"), horizon=8, batch_size=1)
    data.prepare_data()
    data.setup("fit")
    assert data.scene.to_dict() == json.loads((GOLDEN / "dataset" / "scene.json").read_text())
