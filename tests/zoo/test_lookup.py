import json
import sys

import pytest
import torch

from nmpm._support.shipped import shipped_folder
from nmpm.errors import ConfigError, DataError, ZooError
from nmpm.training.module import EmulatorModule
from nmpm.zoo.registry import Zoo, load_model


@pytest.fixture
def run(tmp_path, small):
    """The folder that a training leaves."""
    module = EmulatorModule.of(small, unroll=3)
    content = {"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams), "nmpm_format": 1}
    folder = tmp_path / "runs" / "mine"
    (folder / "checkpoints").mkdir(parents=True)
    for name in ("best", "last"):
        torch.save(content, folder / "checkpoints" / f"{name}.ckpt")
    report = {"dataset": "goop, simulated by nmpm", "test": {"mse": 0.5}, "training": {"steps": 7, "horizon": 99}}
    (folder / "report.json").write_text(json.dumps(report))
    return folder


def same(one, other) -> bool:
    theirs = other.state_dict()
    return all(torch.equal(value, theirs[name]) for name, value in one.state_dict().items())


def test_names_entries_runs_and_checkpoints_give_the_same_model(root, run, small):
    paths = (root / "small", str(root / "small"), run, str(run), run / "checkpoints" / "last.ckpt")
    for model in (Zoo.load("small", root), Zoo.load("small", str(root)), *map(load_model, paths)):
        assert same(model.emulator, small)
        assert not model.emulator.training
        assert not any(weight.requires_grad for weight in model.emulator.parameters())
    assert same(Zoo.load(run).emulator, small)


def test_the_card_of_a_run_says_what_is_known(run):
    best, last = load_model(run), load_model(run / "checkpoints" / "last.ckpt")
    assert (best.horizon, best.preset) == (12, "goop")
    assert best.card["training"] == {"steps": 7, "horizon": 12}
    assert best.card["test"] == {"mse": 0.5}
    assert "test" not in last.card  # which are the best checkpoint's
    (run / "report.json").write_text("[" * 100_000)
    lone = load_model(run)
    assert (lone.horizon, lone.preset, lone.card["dataset"]) == (12, None, "not stated by the checkpoint")


def test_horizon_and_preset_of_entries(root, tmp_path, small, write_entry):
    model = Zoo.load("small", root)
    assert (model.horizon, model.preset) == (16, None)
    write_entry(root / "other", small, dataset="waterramps, simulated by nmpm", training={"horizon": 40})
    model = Zoo.load("other", root)
    assert (model.horizon, model.preset) == (40, "waterramps")
    write_entry(root / "odd", small, dataset=3, training=[])
    assert (Zoo.load("odd", root).horizon, Zoo.load("odd", root).preset) == (16, None)


def test_a_name_comes_before_a_folder_of_that_name(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "goop").symlink_to(run)
    assert load_model("goop").card["name"] == "goop"
    assert load_model("./goop").card["training"]["steps"] == 7


def test_own_entries_stand_beside_the_shipped_ones_and_come_first(home, small, write_entry):
    shipped = Zoo.list()
    write_entry(home / "zoo" / "mine" / "small", small)
    write_entry(home / "zoo" / "goop", small)
    assert Zoo.list() == sorted([*shipped, "mine/small"])
    assert same(Zoo.load("goop").emulator, small)
    assert Zoo.folder("mine/small") == home / "zoo" / "mine" / "small"


def test_folders_that_cannot_be_names_are_not_listed(root, small, write_entry):
    write_entry(root / "Not A Name", small)
    write_entry(root / "a" / "b" / "c", small)
    assert Zoo.list(root) == ["small"]


def test_an_entry_does_not_need_lightning(tmp_path):
    import subprocess

    script = "import sys; from nmpm import Zoo; Zoo.load('goop'); assert 'lightning' not in sys.modules"
    subprocess.run([sys.executable, "-c", script], check=True, cwd=tmp_path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gop", "holds no model 'gop'; it holds .*goop.* Did you mean goop"),
        ("runs/nothing", "No such path exists either"),
        ("x" * 10_000, "holds no model"),
        ("nul\0", "holds no model"),
        (".", "holds no model: neither an entry"),
        ("/dev/null.ckpt", "no such checkpoint"),
    ],
)
def test_what_is_not_there_is_said(name, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ZooError, DataError), match=message) as caught:
        load_model(name)
    assert len(str(caught.value)) < 400


def test_a_root_that_is_no_folder(tmp_path):
    for function in (Zoo.list, lambda root: Zoo.load("goop", root)):
        with pytest.raises(ZooError, match="There is no zoo in"):
            function(str(tmp_path / "nowhere"))


class TestDevices:
    def tensors(self, emulator):
        """All tensors that modules hold, registered or not."""
        for module in emulator.modules():
            for values in (module._parameters, module._buffers, vars(module)):
                yield from (value for value in values.values() if isinstance(value, torch.Tensor))

    @pytest.mark.parametrize("name", Zoo.list(shipped_folder("zoo")))
    def test_weights_and_buffers_move_and_the_first_model_stays(self, name):
        model = Zoo.load(name)
        moved = model.to("meta")
        assert {value.device.type for value in self.tensors(moved.emulator)} == {"meta"}
        assert {value.device.type for value in self.tensors(model.emulator)} == {"cpu"}
        assert moved.emulator.device.type == "meta"
        assert Zoo.load(name, device="meta").emulator.device.type == "meta"

    def test_a_model_that_is_there_already_is_not_copied(self, root):
        model = Zoo.load("small", root)
        assert model.to("cpu") is model

    def test_a_checkpoint_moves_too(self, run):
        assert load_model(run, device="meta").emulator.device.type == "meta"

    def test_a_missing_device_is_an_error_before_anything_is_read(self, tmp_path):
        with pytest.raises(ConfigError, match="has no device 'cuda:77'; it has"):
            load_model("nothing", device="cuda:77")
