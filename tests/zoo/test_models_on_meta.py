"""Rollouts of the shipped models on torch's `meta` device, which stands in for a GPU on a machine without one."""

import dataclasses
from contextlib import nullcontext

import pytest
import torch

from nmpm import Zoo
from nmpm._support.shipped import shipped_folder
from nmpm.emulator import unroll


@pytest.mark.parametrize("name", Zoo.list(shipped_folder("zoo")))
def test_a_rollout_never_leaves_the_device(name, monkeypatch):
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    state = Zoo.load(name, root=shipped_folder("zoo")).example(count=50)  # may depend on values, which meta has none of
    model = Zoo.load(name, root=shipped_folder("zoo"), device="meta")
    if model.scene.obstacles:
        bar = torch.rand(1, 20, model.scene.dim)
        state = dataclasses.replace(state, obstacle=bar, obstacle_mask=torch.ones(1, 20, dtype=torch.bool))
    with torch.no_grad():
        bundles = list(unroll(model.emulator, state.to("meta"), 2))
    assert [bundle.position.device.type for bundle in bundles] == ["meta", "meta"]
    assert bundles[-1].position.shape == (1, model.emulator.frames, *state.position.shape[1:])
