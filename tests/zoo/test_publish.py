"""From a run to an entry: card, README, tables, and weights in float16 where a rollout does not notice."""

import json

import pytest
import torch
from safetensors.torch import load

from nmpm._support.bounded_files import read_yaml
from nmpm._support.shipped import PACKAGE, shipped_folder
from nmpm.emulator.adaptation import with_noise
from nmpm.emulator.digests import float32_digest
from nmpm.errors import ZooError
from nmpm.training.module import EmulatorModule
from nmpm.zoo import Zoo, publish
from nmpm.zoo.card import read_scenes
from nmpm.zoo.publish import add, round_network, serialise


def stress(*verdicts: bool | None) -> str:
    lines = [{"group": "long", "name": str(index), "passed": passed} for index, passed in enumerate(verdicts)]
    return json.dumps({"size": "full", "lines": lines})


def test_an_entry_states_errors_training_constraints_and_stress_tests(run, home):
    (run / "stress.json").write_text(stress(True, True, None))
    (run / "stress_free.json").write_text(stress(True, False))
    folder = add(run, "goop/mine", about="made up")
    assert folder == home / "zoo" / "goop" / "mine"
    model = Zoo.load("goop/mine")
    assert model.card == read_yaml(folder / "card.yaml")
    assert model.card["stress"] == {"size": "full", "passed": 2, "failed": []}
    assert model.card["stress_free"] == {"size": "full", "passed": 1, "failed": ["long: 1"]}
    assert (model.preset, model.horizon, model.card["test_scenes"]) == ("goop", 99, 2)
    assert read_scenes(folder) == [{"mse": 0.1, "mse@100": 0.05}, {"mse": 0.2}]
    assert (folder / "training.csv").read_text() == "seconds,steps,mse\n45.0,35,0.4\n90.0,70,0.3\n"
    text = " ".join((folder / "README.md").read_text().split())
    assert "An emulator of goop, simulated by nmpm. made up" in text
    assert "| **the model** | 0.0342 | 0.558 (100 – 200) |" in text  # as the scenes here are other ones
    assert "| nothing moves | | 53.6 |" in text
    assert 'constraints: 2 of 2 pass, full; with the bounds alone: 1 of 2 pass, full (failed: 1 of "long")' in text
    assert "obstacle" not in text  # the scene has none
    assert "for 7 steps in 1.5 minutes on a CPU, 32-true. 1,234 parameters, stored in float16." in text
    assert f"To cite it: `nmpm`'s model `goop/mine`, SHA-256 of its weights {model.card['sha256'][:12]}…" in text
    assert "(chart.png)" in text


def test_an_entry_of_a_model_that_reads_noise_states_what_its_members_say(run, small, home):
    module = EmulatorModule.of(with_noise(small), unroll=3)
    content = {"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams), "nmpm_format": 1}
    torch.save(content, run / "checkpoints" / "best.ckpt")
    report = json.loads((run / "report.json").read_text())
    density = {"crps": 0.0123, "interval": [0.01, 0.02], "single": 0.04, "spread_skill": 0.9}
    ensemble = {"members": 8, "scores": {"density@100": density | {"coverage50": 0.5, "coverage90": 0.8}}}
    (run / "report.json").write_text(json.dumps(report | {"ensemble": ensemble}))
    text = (add(run, "mine") / "README.md").read_text()
    assert "Fair CRPS ×10⁻³ of 8 members, beside that of a single rollout" in text
    assert "| density, frame 100 | 40 | 12.3 (10–20) | 0.90 | 0.50 | 0.80 |" in text
    model = Zoo.load("mine")
    assert model.card["ensemble"] == ensemble
    assert model.nudge == 0
    assert model.emulator.processor.noise > 0


def test_names_that_are_taken_and_folders_that_cannot_be_written(run, tmp_path):
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


def test_variants_stay_when_the_model_that_they_lie_beside_is_added(run, home):
    fast = add(run, "mine/fast")
    before = {path: path.read_bytes() for path in fast.iterdir()}
    add(run, "mine")
    assert Zoo.variants("mine", home / "zoo") == ["mine", "mine/fast"]
    assert {path: path.read_bytes() for path in fast.iterdir()} == before
    assert [path.name for path in (home / "zoo").glob("**/.*")] == []


@pytest.mark.parametrize(("file", "text"), [("report.json", "{"), ("stress.json", "[]"), ("report.json", "{}")])
def test_reports_that_are_incomplete(run, home, file, text):
    (run / file).write_text(text)
    with pytest.raises(ZooError, match=r"cannot be read|should hold|lacks"):
        add(run, "mine")
    assert not (home / "zoo" / "mine").exists()


def test_the_network_is_stored_in_half_the_bytes_and_statistics_as_they_are(small):
    small.input_std.fill_(1.0001)  # float16 has 1 and 1.001
    rounded = round_network(small)
    stored = load(serialise(rounded, torch.float16))
    for name, value in rounded.state_dict().items():
        assert torch.equal(stored[name].to(value.dtype), value)
        assert (stored[name].dtype == torch.float16) == name.startswith("processor.")
    assert torch.equal(stored["input_std"], small.input_std)
    weight = next(small.processor.parameters())
    assert not torch.equal(weight, next(rounded.processor.parameters()))  # the original is left as it was


def test_weights_beyond_the_range_of_float16_and_where_a_rollout_notices_stay(small, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(publish, "NOTICED", 0.0)
        assert round_network(small) is small
    next(small.processor.parameters()).data.view(-1)[0] = -1e5
    assert round_network(small) is small
