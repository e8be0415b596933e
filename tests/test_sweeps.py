"""Every variant of the shipped sweeps makes a model that predicts."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch
from scenes import cloud

from nmpm.data import catalog

ROOT = Path(__file__).parent.parent / "benchmarks"


def _ablation():
    spec = importlib.util.spec_from_file_location("ablation", ROOT / "ablation.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["ablation"] = module  # where its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


if not ROOT.is_dir():
    pytest.skip("benchmarks are not part of this distribution", allow_module_level=True)
ABLATION = _ablation()
SWEEPS = {path.stem: ABLATION.Sweep.read(path) for path in sorted((ROOT / "sweeps").glob("*.yaml"))}


@pytest.mark.parametrize(("sweep", "variant"), [(s, v) for s, sweep in SWEEPS.items() for v in sweep.variants])
def test_every_variant_makes_a_model(sweep, variant):
    config = SWEEPS[sweep].whole(variant)
    scene = catalog.scene("goop")
    emulator = ABLATION.module_of(config, scene).emulator.eval()
    with torch.no_grad():
        bundle = emulator(cloud(scene))
    assert bundle.position.shape == (1, config["model"]["frames"], 30, 2)
    assert bundle.position.isfinite().all()


def test_steps_of_growing_bundles_are_weighed_by_how_often_they_come(make_dataset):
    config = SWEEPS["paper"].whole("base")
    config["data"] = {"path": str(make_dataset()), "batch_size": 2}
    config["model"] |= {"cells": 16, "frames": 2, "unroll": 2, "unroll_growth": 0.6}
    probe = ABLATION.Probe(config)
    assert probe.shares == {1: 60, 2: 40}
    taken = {1: 1.0, 2: 3.0}
    assert probe.step() > 0
    probe._step = taken.get
    assert probe.step() == pytest.approx(1.8)


def test_a_replaced_part_takes_none_of_the_old_arguments():
    config = SWEEPS["parts"].whole("fno")
    assert set(config["model"]["processor"]["init_args"]) == {"modes", "width", "layers"}
    assert SWEEPS["paper"].whole("depth=2")["model"]["processor"]["init_args"]["width"] == 32


def test_the_table_lists_the_best_first():
    lines = ABLATION.table({"worse": {"mse": 2.0}, "unfinished": {}, "better": {"mse": 1.0, "steps": 10}}).splitlines()
    assert [line.split()[0] for line in lines[1:]] == ["better", "worse", "unfinished"]
