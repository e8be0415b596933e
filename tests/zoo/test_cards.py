import json
from pathlib import Path

import pytest
import torch
import yaml

from nmpm._support.digests import float32_digest
from nmpm._support.shipped import PACKAGE, shipped_folder
from nmpm.errors import ZooError
from nmpm.training.module import EmulatorModule
from nmpm.zoo import Zoo
from nmpm.zoo.cards import readme, stress_line
from nmpm.zoo.publish import add

TEST = {"mse": 0.00055842194, "mse@8": 3.4241e-08, "still/mse": 0.0535708, "free_fall/mse": 0.03128, "emd": 0.012345}


def line(name: str, passed: bool | None) -> dict:
    return {"group": "long", "name": name, "passed": passed, "figures": {}, "needs": ""}


@pytest.fixture
def run(tmp_path, small) -> Path:
    """The folder that a training leaves."""
    module = EmulatorModule.of(small, unroll=2, constraints={"energy": True, "rest_speed": 0.01})
    content = {"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams), "nmpm_format": 1}
    folder = tmp_path / "run"
    (folder / "checkpoints").mkdir(parents=True)
    torch.save(content, folder / "checkpoints" / "best.ckpt")
    training = {"steps": 70, "horizon": 8, "seconds": 90.0, "precision": "32-true", "hardware": "a CPU", "devices": 1}
    report = {
        "dataset": "goop, simulated by nmpm",
        "test": TEST,
        "per_trajectory": {"model": [{"mse": 0.1}, {"mse": 0.2}]},
        "training": training | {"parameters": 1234},
        "versions": {"nmpm": "0"},
    }
    (folder / "report.json").write_text(json.dumps(report))
    held = {"size": "full", "lines": [line("one", True), line("two", True), line("three", None)]}
    free = {"size": "full", "lines": [line("one", True), line("two", False)]}
    (folder / "stress.json").write_text(json.dumps(held))
    (folder / "stress_free.json").write_text(json.dumps(free))
    return folder


def test_an_entry_states_stress_with_and_without_constraints(run, home):
    folder = add(run, "goop/mine")
    assert folder == home / "zoo" / "goop" / "mine"
    model = Zoo.load("goop/mine")
    assert model.card["stress"] == {"size": "full", "passed": 2, "failed": []}
    assert model.card["stress_free"] == {"size": "full", "passed": 1, "failed": ["long: two"]}
    assert (model.preset, model.horizon) == ("goop", 8)
    text = (folder / "README.md").read_text()
    assert "held: 2 of 2 lines passed, full; free: 1 of 2 lines passed, full (failed: long: two)" in text
    assert "energy (kinetic plus potential energy never exceeds" in text
    assert "rest_speed = 0.01 cells per frame" in text
    assert "solids" not in text  # the scene has none
    assert (
        "Trained for 70 steps in 1.5 minutes on a CPU, 32-true; 1,234 parameters, stored in float16; one run." in text
    )
    assert "of one run, over 2 trajectories" in text
    weights = model.card["sha256"][:12]
    assert f"Licence: MIT. To cite it: `nmpm`'s model `goop/mine`, SHA-256 of its weights {weights}…" in text
    assert "arXiv 2408.15753" in text


def test_errors_have_three_digits(run):
    text = (add(run, "mine") / "README.md").read_text()
    assert "| model | 3.42e-05 | 0.558 | 12.3 |" in text
    assert "| nothing moves |  | 53.6 |  |" in text


@pytest.mark.parametrize("name", ["goop", "waterdrop", "waterramps"])
def test_cards_of_version_0_1_are_readable(name):
    golden = Path(__file__).parents[1] / "golden" / "zoo"
    card = Zoo.card(name, golden)
    assert f"# {name}" in readme(card)
    assert "free: not run" in stress_line(card)


def test_names_that_are_taken_and_folders_that_cannot_be_written(run, tmp_path):
    add(run, "mine")
    with pytest.raises(ZooError, match="mine exists: choose another name"):
        add(run, "mine")
    with pytest.raises(ZooError, match="goop exists: choose another name"):
        add(run, "goop")
    assert add(run, "goop", str(tmp_path / "other")).is_dir()
    with pytest.raises(ZooError, match="part of the installed package"):
        add(run, "mine", PACKAGE / "_shipped" / "zoo")
    (tmp_path / "file").touch()
    with pytest.raises(ZooError, match="cannot be written"):
        add(run, "mine", tmp_path / "file")
    assert sorted(path.name for path in shipped_folder("zoo").glob(".*")) == []


def test_a_report_of_other_weights_is_refused(run, small):
    path = run / "report.json"
    report = json.loads(path.read_text())
    module = EmulatorModule.of(small, unroll=2)
    path.write_text(json.dumps(report | {"weights": float32_digest(module.state_dict())}))
    add(run, "mine")
    path.write_text(json.dumps(report | {"weights": "of others"}))
    with pytest.raises(ZooError, match=r"report.json is of other weights than .*best.ckpt: test these"):
        add(run, "others")


def test_variants_stay_when_the_model_that_they_lie_beside_is_written(run, home):
    fast = add(run, "mine/fast")
    before = {path: path.read_bytes() for path in fast.iterdir()}
    assert Zoo.variants("mine", home / "zoo") == ["mine/fast"]
    add(run, "mine", home / "zoo")
    assert Zoo.variants("mine", home / "zoo") == ["mine", "mine/fast"]
    assert {path: path.read_bytes() for path in fast.iterdir()} == before
    assert [path.name for path in (home / "zoo").glob("**/.*")] == []


@pytest.mark.parametrize("file", ["report.json", "stress.json"])
@pytest.mark.parametrize("text", ["{", "[]", "{}"])
def test_reports_that_are_incomplete(run, home, file, text):
    (run / file).write_text(text)
    with pytest.raises(ZooError, match=r"cannot be read|should hold|lacks"):
        add(run, "mine")
    assert not (home / "zoo" / "mine").exists()


def test_the_text_of_a_card_is_yaml_of_plain_data(run):
    folder = add(run, "mine", about="made up")
    card = yaml.safe_load((folder / "card.yaml").read_text())
    assert card["about"] == "made up"
    held = {"energy": True, "rest_speed": 0.01, "solids": True, "bounds": "stop", "density_cap": 0.0}
    assert card["constraints"] == held
