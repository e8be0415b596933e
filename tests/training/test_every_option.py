"""Every option of models and data changes something that one sees, or is refused; a new one needs a line here."""

import dataclasses
import inspect
from collections.abc import Iterator
from itertools import islice
from typing import Any

import lightning
import pytest
import torch

from nmpm import EmulatorModule, TrajectoryDataModule, rollout
from nmpm.cli import main
from nmpm.decoders import Absolute
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.errors import ConfigError, DataError
from nmpm.metrics import MSE
from nmpm.optimizers import SOAP
from nmpm.processors import UNet
from nmpm.training import module as training_module
from nmpm.training.losses import PositionLoss
from nmpm.training.optimization import Schedule
from nmpm.transfer import Nearest
from tests.trainings import QUIET, TINY

MODEL = {"cells": 8, "frames": 2, "processor": TINY, "schedule": Schedule(warmup=2)}
CHANGED_MODEL: dict[str, Any] = {
    "unroll": 1,
    "unroll_growth": 0.9,
    "gradient_discount": 1.0,
    "optimizer": SOAP,
    "schedule": Schedule(warmup=1, start=0.5),
    "loss": PositionLoss(power=1.0),
    "members": 2,
    "position_noise": 1e-3,
    "mirror": (0,),
    "jitter": 0.15,
    "metrics": [MSE(horizons=(3,))],
    "recompute": True,
    "compile": True,
    "record": True,
    "seed": 1,
    "cells": 10,
    "frames": 1,
    "transfer": Nearest(),
    "processor": UNet(width=6, depth=1, perceptron=(4,)),
    "decoder": Absolute(),
    "grid_noise": 0.1,
    "constraints": Constraints(rest_speed=5.0),
}
CHANGED_LOSS = {"power": 1.0, "density_weight": 0.0, "field_weight": 0.0}
CHANGED_CONSTRAINTS = {"energy": True, "rest_speed": 0.1, "solids": False, "bounds": "reflect", "density_cap": 0.2}
DATA = {"horizon": 4, "batch_size": 2, "buffer_size": 2, "passes": 1.0}
CHANGED_DATA: dict[str, Any] = {
    "horizon": 6,
    "batch_size": 3,
    "buffer_size": 1,
    "passes": 3.0,
    "emphasis": 1.0,
    "openings": 1.0,
    "bucket_batches": 4,
    "seed": 1,
    "boundary": ["periodic", "wall"],
    "bounds": [(0.05, 0.95), (0.05, 0.95)],
    "fields": [],
    "prescribed": [3],
    "limit_eval": 1,
    "eval_batch_size": 1,
}
ELSEWHERE = {"gravity", "family", "path", "name", "source", "generate", "reading", "resample", "smooth", "files"}
"""Options of data that tests of their own change."""
IN_EACH_RUN = ("gradient_discount", "emphasis", "density_cap")


def marked(options: dict[str, Any]) -> list[Any]:
    return [pytest.param(name, marks=[] if name in IN_EACH_RUN else pytest.mark.slow) for name in options]


@pytest.fixture
def folder(make_dataset):
    sizes = ((24, 5), (24, 9), (24, 7))
    return make_dataset(train=sizes, valid=((12, 5), (12, 4)), statics=3, fields=("temperature",))


def names_of(kind: type) -> set[str]:
    return set(inspect.signature(kind).parameters) - {"self", "scene", "recipe"}


def test_every_option_has_a_line():
    of_matches = {"scene", "particles_per_cell"}  # the second changes no training
    recipe = {field.name for field in dataclasses.fields(EmulatorRecipe)} - of_matches
    assert set(CHANGED_MODEL) == names_of(EmulatorModule) | recipe
    assert set(CHANGED_CONSTRAINTS) == {field.name for field in dataclasses.fields(Constraints)}
    assert {*CHANGED_DATA, *ELSEWHERE} == names_of(TrajectoryDataModule)


def train(folder, calls: list[str], **options) -> dict[str, Any]:
    """What one sees of a training of three steps: weights, errors by name, and how often the network is called."""
    torch.manual_seed(0)
    data = TrajectoryDataModule(path=str(folder), **DATA)
    model = EmulatorModule(data.scene, **(MODEL | options))
    counted: list[int] = []
    model.emulator.processor.register_forward_hook(lambda *_: counted.append(1))
    trainer = lightning.Trainer(
        accelerator="cpu", max_steps=3, limit_val_batches=1, val_check_interval=3, check_val_every_n_epoch=None,
        enable_checkpointing=False, **QUIET,
    )  # fmt: skip
    trainer.fit(model, data)
    errors = {name: float(value) for name, value in trainer.callback_metrics.items()}
    weights = torch.cat([values.double().flatten() for values in model.emulator.state_dict().values()]).tolist()
    return {"weights": weights, "errors": errors, "calls": len(counted), "compiled": list(calls)}


@pytest.mark.parametrize("name", marked(CHANGED_MODEL))
def test_model(name, folder, monkeypatch):
    compiled: list[str] = []  # networks that were to be compiled, which is not done
    monkeypatch.setattr(
        training_module.preflight, "compile_network", lambda network, _: compiled.append(type(network).__name__)
    )
    monkeypatch.setattr(training_module, "can_record", lambda _: bool(compiled.append("recorded")))  # likewise
    common = {"position_noise": 1e-3} if name == "seed" else {}
    before = train(folder, compiled, **common)
    assert before == train(folder, compiled, **common)
    assert before != train(folder, compiled, **(common | {name: CHANGED_MODEL[name]}))


@pytest.mark.parametrize("name", marked(CHANGED_CONSTRAINTS))
def test_constraints(name, folder):
    data = TrajectoryDataModule(path=str(folder), **DATA)
    torch.manual_seed(0)
    emulator = EmulatorModule(data.scene, **MODEL).emulator.eval()
    emulator.output_scale.fill_(0.02)
    emulator.calibrated.fill_(True)
    data.setup("fit")
    state = next(iter(data.val_dataloader())).initial
    changed = {name: CHANGED_CONSTRAINTS[name]}
    with torch.no_grad():
        rollouts = [rollout(emulator.with_constraints(Constraints(**given)), state, 24) for given in ({}, {}, changed)]
    assert torch.equal(rollouts[0], rollouts[1])
    assert not torch.equal(rollouts[0], rollouts[2])


def windows(folder, **options) -> Iterator[Any]:
    """What one sees of data: the facts of the scene, training windows in their order, and validation batches."""
    data = TrajectoryDataModule(**({"path": folder and str(folder)} | DATA | options))
    data.prepare_data()
    yield data.scene
    data.setup("fit")
    for batch in islice(data.train_dataloader(), 30):
        yield batch.frames.shape, batch.frames.double().sum((1, 2, 3)).tolist()
    for batch in data.val_dataloader():
        yield batch.frames.shape, batch.frames.double().sum().item()


@pytest.mark.parametrize("name", marked(CHANGED_DATA))
def test_data(name, folder):
    before = list(windows(folder))
    assert before == list(windows(folder))
    assert before != list(windows(folder, **{name: CHANGED_DATA[name]}))


def test_facts_that_contradict_the_data_are_refused_or_not_used(folder):
    with pytest.raises((ConfigError, DataError), match="gravity"):
        list(windows(folder, gravity=[0.0, -1.0]))
    with pytest.warns(UserWarning, match="3 = boundary, not rigid.*the family lagrangebench is not used"):
        assert list(windows(folder, family="lagrangebench")) == list(windows(folder))


@pytest.mark.slow
def test_sources(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    few = {"counts": {"train": 1, "valid": 1, "test": 1}, "frames": 8}
    simulated = {"name": "goop", "generate": few}
    seen = [
        list(windows(None, **options))
        for options in (
            {"path": str(folder)},
            simulated,
            {"name": "waterdrop", "generate": few},
            {"name": "goop", "generate": few | {"seed": 1}},
            simulated | {"source": "simulate"},
        )
    ]
    assert all(one != other for index, one in enumerate(seen) for other in seen[:index])


@pytest.mark.parametrize("option", ["--model.unrol=3", "--data.batchsize=3", "--trainer.steps=3", "--modl.unroll=3"])
def test_unknown_options_are_refused(option, capsys):
    assert main(["fit", "--config", "goop.yaml", option]) != 0
    assert option.partition("=")[0] in capsys.readouterr().err
