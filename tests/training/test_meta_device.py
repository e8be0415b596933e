"""Every shipped configuration on torch's `meta` device, which stands in for a GPU on a machine without one.

Its tensors hold no values: mixing them with tensors of the CPU raises, and so does reading one back. The order is
Lightning's: `setup` with the model still on the host, then the move to the device, then `on_fit_start` with windows
that are on the device.
"""

import contextlib
from dataclasses import replace
from functools import partial
from importlib import import_module
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import torch
import yaml
from torch.fx.experimental._config import patch as config_patch

from nmpm._support.shipped import config_names, find_config
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator.rollouts import unroll
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.scene import Scene
from nmpm.training import EmulatorModule
from tests.emulator.test_emulator_on_meta import WatchCopies

META = torch.device("meta")


@pytest.fixture(autouse=True)
def no_autocast(monkeypatch):
    """There is no autocast on this device."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())


def build_module(config: str, scene: Scene) -> EmulatorModule:
    """The module of a configuration, with a tiny network; its optimizer is built on the device later."""
    model = yaml.safe_load(find_config(config).read_text())["model"]
    processor = model["processor"]
    while "processor" in processor["init_args"]:  # of a wrapper, such as Patched
        processor = processor["init_args"]["processor"]
    processor["init_args"] |= {"width": 4, "depth": 1, "perceptron": [4]}
    metrics = [MSE(**chosen["init_args"]) for chosen in model.pop("metrics", ())]
    optimizer = model.pop("optimizer")
    kind = getattr(
        import_module(optimizer["class_path"].rpartition(".")[0]), optimizer["class_path"].rpartition(".")[2]
    )
    model |= {"cells": 8, "frames": 2, "unroll": 2, "metrics": metrics or None}
    return EmulatorModule(scene, optimizer=partial(kind, **optimizer["init_args"]), **model)


class OnDevice(NamedTuple):
    """A module after `on_fit_start`, and windows to train on and to evaluate, all on the device."""

    module: EmulatorModule
    short: Window
    whole: Window


@pytest.fixture(params=[0, 3], ids=["no obstacle", "obstacles"])
def obstacles(request) -> int:
    return request.param


IN_EACH_RUN = ("goop.yaml", "waterdrop3d.yaml")
CONFIGS = [pytest.param(name, marks=[] if name in IN_EACH_RUN else pytest.mark.slow) for name in config_names()]


@pytest.fixture(params=CONFIGS)
def fitted(request, make_dataset, monkeypatch, obstacles) -> OnDevice:
    data = TrajectoryDataModule(path=str(make_dataset(statics=obstacles)), horizon=4, batch_size=2)
    module = build_module(request.param, data.scene)
    data.setup("fit")
    short, whole = (next(iter(loader)).to(META) for loader in (data.train_dataloader(), data.val_dataloader()))
    trainer = SimpleNamespace(
        datamodule=SimpleNamespace(scene=data.scene, train_dataloader=lambda: [short, short]),
        strategy=SimpleNamespace(root_device=META),
        world_size=1,
    )
    monkeypatch.setattr(EmulatorModule, "trainer", trainer)
    module.setup("fit")
    module.to(META)
    module.emulator.calibrated = torch.zeros((), dtype=torch.bool)  # read once, at the start
    with config_patch(meta_nonzero_assume_all_nonzero=True):  # calibration selects particles; a training step must not
        module.on_fit_start()
    monkeypatch.setattr(module, "log", lambda *_, **__: None)
    return OnDevice(module, short, whole)


def test_steps_and_evaluations_never_leave_the_device_until_figures_are_read(fitted):
    module, short, whole = fitted
    module.train()
    loss = module.training_step(short, 0)
    assert loss.device == META
    loss.backward()
    assert all(weight.grad.device == META for weight in module.parameters())
    with WatchCopies():  # as steps are recorded
        for window in (short, replace(short, volume=torch.ones_like(short.frames[:, 0, :, 0]))):
            module._mean_error(2, module.emulator, window.initial, window)
    assert all(buffer.device == META for name, buffer in module.emulator.named_buffers() if name != "calibrated")
    module.eval()
    with torch.no_grad():
        predicted = torch.cat([bundle.position for bundle in unroll(module.emulator, whole.initial, 5)], dim=1)
        assert predicted.device == META
        assert predicted.shape == whole.target.shape
        module.on_validation_epoch_start()
        module.valid_errors.update(whole, predicted)


def test_mixing_devices_is_noticed():
    with pytest.raises(RuntimeError, match="meta"):
        torch.ones(2) + torch.ones(2, device=META)
    with pytest.raises((RuntimeError, NotImplementedError)):
        bool(torch.ones((), device=META))
