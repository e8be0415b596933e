"""Every variant of the shipped sweeps builds a model that predicts."""

import importlib
import sys
from pathlib import Path

import pytest
import torch
from scenes import cloud

from nmpm.data import catalog

ROOT = Path(__file__).parent.parent / "benchmarks"


def _import_ablation():
    sys.path.insert(0, str(ROOT))
    try:
        return importlib.import_module("ablation")
    finally:
        sys.path.remove(str(ROOT))


if not ROOT.is_dir():
    pytest.skip("benchmarks are not part of this distribution", allow_module_level=True)
ABLATION = _import_ablation()
SWEEPS = {path.stem: ABLATION.Sweep.read(path) for path in sorted((ROOT / "sweeps").glob("*.yaml"))}


@pytest.mark.parametrize(("sweep", "variant"), [(s, v) for s, sweep in SWEEPS.items() for v in sweep.variants])
def test_every_variant_builds_a_model(sweep, variant):
    config = SWEEPS[sweep].config_of(variant)
    scene = catalog.scene("goop")
    emulator = ABLATION.build_module(config, scene).emulator.eval()
    with torch.no_grad():
        bundle = emulator(cloud(scene))
    assert bundle.position.shape == (1, config["model"]["frames"], 30, 2)
    assert bundle.position.isfinite().all()


def test_step_time_is_weighted_by_how_often_each_number_of_bundles_is_unrolled(make_dataset):
    config = SWEEPS["paper"].config_of("base")
    config["data"] = {"path": str(make_dataset()), "batch_size": 2}
    config["model"] |= {"cells": 16, "frames": 2, "unroll": 2, "unroll_growth": 0.6}
    timer = ABLATION.VariantTimer(config, torch.device("cpu"))
    assert timer.shares == {1: 60, 2: 40}
    taken = {1: 1.0, 2: 3.0}
    assert timer.time_step() > 0
    assert timer.time_call() > 0
    assert timer.count_costs()["parameters"] > 0
    timer._time_unrolled = taken.get
    assert timer.time_step() == pytest.approx(1.8)


def test_a_replaced_part_does_not_inherit_the_old_arguments():
    config = SWEEPS["parts"].config_of("fno")
    assert set(config["model"]["processor"]["init_args"]) == {"modes", "width", "layers"}
    assert SWEEPS["paper"].config_of("depth=2")["model"]["processor"]["init_args"]["width"] == 32


def test_the_table_lists_the_best_first():
    results = {"worse": {"mse": 2.0}, "unfinished": {}, "better": {"mse": 1.0, "steps": 10}}
    lines = ABLATION.format_table(results).splitlines()
    assert [line.split()[0] for line in lines[1:]] == ["better", "worse", "unfinished"]


def test_results_are_saved_at_every_change(tmp_path):
    results = ABLATION.Results(tmp_path / "new" / "results.json")
    results.update({"unet": {"gflop": 1.0}, "fno": {"gflop": 2.0}})
    results.update({"unet": {"mse": 0.5}})
    rows = ABLATION.Results(tmp_path / "new" / "results.json").rows
    assert rows == {"unet": {"gflop": 1.0, "mse": 0.5}, "fno": {"gflop": 2.0}}


def test_muon_orthogonalises_convolutions_only(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    muon = importlib.import_module("muon")
    network = torch.nn.Sequential(torch.nn.Conv2d(2, 3, 3), torch.nn.Conv2d(3, 1, 1))
    optimizer = muon.ConvolutionMuon(network.parameters(), lr=0.01)
    orthogonalised = {id(p) for group in optimizer.param_groups if group["use_muon"] for p in group["params"]}
    assert orthogonalised == {id(network[0].weight), id(network[1].weight)}
    before = [p.clone() for p in network.parameters()]
    network(torch.ones(1, 2, 5, 5)).sum().backward()
    optimizer.step()
    assert all(not torch.equal(old, new) for old, new in zip(before, network.parameters(), strict=True))
