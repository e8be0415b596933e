"""Models by name, path or id; damaged and foreign entries; variants chosen by error and time; devices."""

import dataclasses
import subprocess
import sys
from contextlib import nullcontext

import pytest
import torch
import yaml

from nmpm._support.shipped import shipped_folder
from nmpm.emulator import unroll
from nmpm.emulator.rollouts import rollout
from nmpm.errors import ConfigError, DataError, ZooError
from nmpm.zoo import Zoo, load_model
from nmpm.zoo.registry import Limits

SHIPPED = Zoo.list(shipped_folder("zoo"))
GPU = {"hardware": "a GPU"}


def same(one, other) -> bool:
    theirs = other.state_dict()
    return all(torch.equal(value, theirs[name]) for name, value in one.state_dict().items())


def test_names_entries_runs_and_checkpoints_give_the_same_model(root, run, small):
    paths = (root / "small", str(root / "small"), run, str(run), run / "checkpoints" / "last.ckpt")
    for model in (Zoo.load("small", root), Zoo.load("small", str(root)), Zoo.load(run), *map(load_model, paths)):
        assert same(model.emulator, small)
        assert (model.emulator.recipe, model.emulator.training) == (small.recipe, False)
        assert not any(weight.requires_grad for weight in model.emulator.parameters())
    state = Zoo.load("small", root).example(seed=3, count=100)
    assert torch.equal(Zoo.load("small", root).rollout(state, 10), rollout(small, state, 10))


def test_the_card_of_a_run_says_what_is_known(run):
    best, last = load_model(run), load_model(run / "checkpoints" / "last.ckpt")
    assert (best.horizon, best.preset) == (12, "goop")
    assert (best.card["training"]["steps"], best.card["training"]["horizon"]) == (7, 12)
    assert best.card["test"]["mse"] == 0.00055842194
    assert "test" not in last.card  # which are the best checkpoint's
    (run / "report.json").write_text("[" * 100_000)
    lone = load_model(run)
    assert (lone.horizon, lone.preset, lone.card["dataset"]) == (12, None, "not stated by the checkpoint")


def test_a_name_comes_before_a_folder_and_ones_own_entries_before_the_shipped(
    home, tmp_path, monkeypatch, run, small, write_entry
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "goop").symlink_to(run)
    assert load_model("goop").card["name"] == "goop"
    assert load_model("./goop").card["training"]["steps"] == 7
    shipped = Zoo.list()
    for name in ("mine/small", "goop", "Not A Name", "a/b/c"):
        write_entry(home / "zoo" / name, small)
    assert Zoo.list() == sorted([*shipped, "mine/small"])
    assert same(Zoo.load("goop").emulator, small)
    assert Zoo.folder("mine/small") == home / "zoo" / "mine" / "small"


def test_an_entry_needs_no_reader_of_data_and_no_large_library(tmp_path):
    script = """
import sys
from nmpm import Zoo
Zoo.load("goop")
assert not {"lightning", "matplotlib", "scipy.signal", "scipy.spatial", "nmpm.data.convert"} & {*sys.modules}
assert sum(name.startswith("nmpm.data") for name in sys.modules) <= 12
"""
    subprocess.run([sys.executable, "-c", script], check=True, cwd=tmp_path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gop", "holds no model 'gop'; it holds .*goop.* Did you mean goop"),
        ("runs/nothing", "No such path exists either"),
        ("x" * 10_000, "holds no model"),
        (".", "holds no model: neither an entry"),
        ("/dev/null.ckpt", "no such checkpoint"),
    ],
)
def test_a_model_that_is_not_there_is_named(name, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ZooError, DataError), match=message) as caught:
        load_model(name)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("name", ["small/../small", "/etc", "a/b/c", "Small", ""])
def test_names_cannot_lead_out_of_the_zoo(root, name):
    with pytest.raises(ZooError, match="cannot name a model"):
        Zoo.load(name, root)


@pytest.mark.parametrize("file", ["config.yaml", "model.safetensors", "card.yaml"])
def test_damaged_entries_are_refused(root, file):
    path = root / "small" / file
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], content[:-2] + b"\x01\x02"):
        path.write_bytes(damaged)
        with pytest.raises(ZooError, match="SHA-256" if file == "model.safetensors" else file):
            Zoo.load("small", root)
    path.unlink()
    with pytest.raises(ZooError):
        Zoo.load("small", root)


@pytest.mark.parametrize("other", [2, None], ids=str)
def test_cards_of_other_formats_are_refused(root, other):
    path = root / "small" / "card.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"format": other}))
    with pytest.raises(ZooError, match=rf"card.yaml has format {other}; this nmpm reads 1: use a"):
        Zoo.card("small", root)


def test_nothing_that_a_file_names_is_imported(root, tmp_path, monkeypatch):
    (tmp_path / "trap.py").write_text("raise SystemError('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = root / "small" / "config.yaml"
    config = yaml.safe_load(path.read_text())
    config["processor"]["class_path"] = "trap.Net"
    path.write_text(yaml.safe_dump(config))
    with pytest.raises(ZooError, match="trap"):
        Zoo.load("small", root)
    path.write_text("!!python/object/apply:os.system ['true']\n")
    with pytest.raises(ZooError, match="cannot be read"):
        Zoo.load("small", root)


# ---- variants


@pytest.fixture
def pond(root, small, write_entry):
    """Three variants with times, and beside them ones without a time, without an error, and with a bad card."""
    for name, mse, milliseconds in (("accurate", 0.1, 9.0), ("balanced", 0.2, 3.0), ("fast", 0.4, 1.0)):
        write_entry(root / "pond" / name, small, test={"mse": mse}, speed=[GPU | {"ms_per_frame": milliseconds}])
    write_entry(root / "pond" / "untimed", small, test={"mse": 0.05})
    write_entry(root / "pond" / "malformed", small, test={"mse": 0.06}, speed=[GPU, "x"])
    for name, mse, milliseconds in (("diverged", float("nan"), 0.1), ("odd", 0.15, float("nan")), ("minus", 0.15, -1)):
        write_entry(root / "pond" / name, small, test={"mse": mse}, speed=[GPU | {"ms_per_frame": milliseconds}])
    write_entry(root / "pond" / "damaged", small)
    (root / "pond" / "damaged" / "card.yaml").write_text("{")
    return root


@pytest.mark.parametrize(
    ("limits", "chosen"),
    [
        ({"variant": "fast"}, "fast"),
        ({"max_ms_per_frame": 5.0, **GPU}, "balanced"),
        ({"max_mse": 0.3, **GPU}, "balanced"),
        ({"max_mse": 0.3, "max_ms_per_frame": 20.0, **GPU}, "accurate"),
        ({"max_mse": 0.07, **GPU}, "untimed"),  # the most accurate, where none that is accurate enough has a time
        ({"max_mse": 0.3}, "untimed"),  # without times, the most accurate
        ({"max_ms_per_frame": 1e9, "calibrate": True}, "untimed"),
    ],
    ids=str,
)
def test_a_variant_is_chosen_by_name_error_or_time(pond, limits, chosen):
    assert Zoo.load("pond", pond, **limits).card == Zoo.card(f"pond/{chosen}", pond)


def test_limits_that_no_variant_keeps_or_no_card_states_are_named(pond):
    with pytest.raises(ZooError, match=r"within the limits\. .*pond/fast: MSE 0\.4, 1 ms"):
        Zoo.load("pond", pond, max_ms_per_frame=0.5, **GPU)
    with pytest.raises(ZooError, match=r"state no time on this machine, but on a GPU .*calibrate=True"):
        Zoo.load("pond", pond, max_ms_per_frame=5.0)
    with pytest.raises(ZooError, match=r"no model 'pond/slow'; .* Of pond it has pond/accurate, pond/balanced, .*fast"):
        Zoo.load("pond", pond, variant="slow")
    path = pond / "small" / "card.yaml"
    path.write_text(yaml.safe_dump({"format": 1, "test": None}))
    with pytest.raises(ZooError, match="None states an error"):
        Zoo.load("small", pond, max_mse=1.0)
    path.write_text("{")
    with pytest.raises(ZooError, match=r"card\.yaml cannot be read"):
        Zoo.load("small", pond, max_mse=1.0)


@pytest.mark.parametrize("value", [0, float("nan"), "0.1", True], ids=repr)
def test_limits_are_positive_numbers(value):
    with pytest.raises(ConfigError, match=rf"max_mse = {value!r} must be a positive number"):
        Limits(max_mse=value)


def test_options_that_make_no_sense_together_are_refused(root, monkeypatch):
    monkeypatch.chdir(root)
    for option in ({"calibrate": True}, GPU):
        with pytest.raises(ConfigError, match="give max_mse or max_ms_per_frame too"):
            Zoo.load("small", root, **option)
    with pytest.raises(ConfigError, match="hardware = 'a GPU' takes stated times: give one"):
        Zoo.load("small", root, max_mse=1.0, calibrate=True, **GPU)
    for model in (root / "small", "./small", "lab/small@main"):
        with pytest.raises(ConfigError, match="is one model: variant, max_mse and max_ms_per_frame choose among"):
            Zoo.load(model, max_mse=1.0)


# ---- shipped models, and devices


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == "goop" else pytest.mark.slow) for n in SHIPPED])
def test_shipped_models_stay_in_the_box_and_move_to_a_device(name, monkeypatch):
    model = Zoo.load(name)
    state = model.example(count=100)
    positions = model.rollout(state, 24)
    low, high = torch.tensor(model.scene.bounds).T
    assert ((positions >= low - 1e-5) & (positions <= high + 1e-5)).all()
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    moved = model.to("meta")  # which raises where devices are mixed
    if model.scene.obstacles:
        bar = torch.rand(1, 20, model.scene.dim)
        state = dataclasses.replace(state, obstacle=bar, obstacle_mask=torch.ones(1, 20, dtype=torch.bool))
    with torch.no_grad():
        bundles = list(unroll(moved.emulator, state.to("meta"), 2))
    assert [bundle.position.device.type for bundle in bundles] == ["meta", "meta"]
    assert {value.device.type for value in model.emulator.state_dict().values()} == {"cpu"}


def test_a_missing_device_is_an_error_before_anything_is_read_and_a_present_one_copies_nothing(root):
    with pytest.raises(ConfigError, match="has no device 'cuda:77'; it has"):
        load_model("nothing", device="cuda:77")
    model = Zoo.load("small", root)
    assert model.to("cpu") is model
