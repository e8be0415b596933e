"""A checkpoint and a dataset that were written before load, and give the same rollout and scene."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import torch

from nmpm import Particles
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator.rollouts import rollout
from nmpm.training.module import load_module

GOLDEN = Path(__file__).parent / "golden"


def test_a_checkpoint_rolls_out_the_same():
    emulator = load_module(GOLDEN / "checkpoint.ckpt").emulator.eval()
    content = np.load(GOLDEN / "checkpoint.npz")
    names = {field.name for field in dataclasses.fields(Particles)} & set(content)
    state = Particles(**{name: torch.from_numpy(content[name]) for name in names})
    for name, model in (("held", emulator), ("free", emulator.unconstrained())):
        positions = rollout(model, state, 32)[:, 7::8]
        torch.testing.assert_close(positions, torch.from_numpy(content[name]), atol=2e-5, rtol=0)


def test_a_dataset_gives_the_same_scene():
    data = TrajectoryDataModule(path=str(GOLDEN / "dataset"), horizon=8, batch_size=1)
    data.prepare_data()
    data.setup("fit")
    assert data.scene.to_dict() == json.loads((GOLDEN / "dataset" / "scene.json").read_text())
