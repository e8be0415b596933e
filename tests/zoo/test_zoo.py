import numpy as np
import pytest
import torch
import yaml

from nmpm._support.plain_data import from_spec
from nmpm._support.shipped import shipped_folder
from nmpm.cli import main
from nmpm.data.format import Split
from nmpm.decoders import Flip
from nmpm.emulator.rollouts import rollout
from nmpm.errors import ConfigError, ZooError
from nmpm.processors import Processor
from nmpm.transfer import Quadratic
from nmpm.zoo import Zoo


def test_a_model_comes_back_as_it_was(root):
    assert Zoo.list(root) == ["small"]
    model = Zoo.load("small", root)
    assert model.card == Zoo.card("small", root)
    assert (model.emulator.transfer, model.emulator.decoder) == (Quadratic(), Flip())
    assert (model.emulator.input_std == 2.0).all()
    assert not model.emulator.training
    state = model.example(seed=3, count=100)
    assert torch.equal(model.rollout(state, 10), rollout(model.emulator, state, 10))


def test_networks_run_in_known_precisions_only(root):
    model = Zoo.load("small", root)
    assert model.with_network("bfloat16").emulator.network_precision == torch.bfloat16
    with pytest.raises(ConfigError, match="float32 or bfloat16, not in 'float61'"):
        model.with_network("float61")


@pytest.mark.parametrize("name", ["../small", "small/../small", "/etc", "a/b/c", "Small", "", ".", "small/"])
def test_names_cannot_lead_out_of_the_zoo(root, name):
    with pytest.raises(ZooError, match="cannot name a model"):
        Zoo.load(name, root)


def test_unknown_models_are_named_with_the_known_ones(root):
    with pytest.raises(ZooError, match=r"'lava'.*small"):
        Zoo.load("lava", root)


def test_changed_weights_are_refused(root):
    path = root / "small" / "model.safetensors"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(ZooError, match="SHA-256"):
        Zoo.load("small", root)


@pytest.mark.parametrize("file", ["config.yaml", "model.safetensors", "card.yaml"])
@pytest.mark.parametrize("damage", ["missing", "truncated"])
def test_damaged_entries_are_refused(root, file, damage):
    path = root / "small" / file
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ZooError):
        Zoo.load("small", root)


@pytest.mark.parametrize("other", [2, "1.1", None], ids=str)
def test_cards_of_other_formats_are_refused(root, other):
    path = root / "small" / "card.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"format": other}))
    for read in (Zoo.load, Zoo.card):
        with pytest.raises(ZooError, match=rf"card.yaml has format {other}; this nmpm reads 1: pip install"):
            read("small", root)


def test_weights_that_are_not_finite_are_refused(root, tmp_path, write_entry):
    emulator = Zoo.load("small", root).emulator
    emulator.input_mean.fill_(float("nan"))
    write_entry(tmp_path / "zoo" / "poisoned", emulator)
    with pytest.raises(ZooError, match=r"input_mean.*not finite"):
        Zoo.load("poisoned", root)


def test_nothing_that_a_file_names_is_imported(root, tmp_path, monkeypatch):
    (tmp_path / "trap.py").write_text("raise SystemError('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=r"trap\.Net.*not known"):
        from_spec({"class_path": "trap.Net", "init_args": {}}, Processor)
    path = root / "small" / "config.yaml"
    config = yaml.safe_load(path.read_text())
    config["processor"]["class_path"] = "trap.Net"
    path.write_text(yaml.safe_dump(config))
    with pytest.raises(ZooError, match="trap"):
        Zoo.load("small", root)
    path.write_text("!!python/object/apply:os.system ['true']\n")
    with pytest.raises(ZooError, match="cannot be read"):
        Zoo.load("small", root)


def test_a_shipped_model_rolls_out_and_renders_from_the_shell(tmp_path, monkeypatch):
    names = Zoo.list()
    if not names:
        pytest.skip("the zoo is empty")
    monkeypatch.chdir(tmp_path)
    assert main(["rollout", names[0], "--frames", "12", "--out", "out.h5", "--particles", "200", "--blocks", "2"]) == 0
    trajectory = Split(tmp_path / "out.h5").read(0)
    assert trajectory.position.shape[0] == 14
    rough = ["--particles", "200", "--blocks", "2", "--precision", "bfloat16", "--out", "rough.h5"]
    assert main(["rollout", names[0], "--frames", "12", *rough]) == 0
    apart = np.abs(Split(tmp_path / "rough.h5").read(0).position - trajectory.position).max()
    assert 0 < apart < 0.01
    assert main(["render", "out.h5"]) == 0
    assert (tmp_path / "out.png").stat().st_size > 1000
    assert (tmp_path / "out.gif").stat().st_size > 1000
    assert main(["rollout", names[0], "--data", "out.h5", "--frames", "3", "--out", "again.h5"]) == 1


@pytest.mark.parametrize("name", Zoo.list(shipped_folder("zoo")))
def test_shipped_models_keep_particles_in_the_box_and_beat_the_trivial_predictors(name):
    model = Zoo.load(name)
    positions = model.rollout(model.example(count=300), 100)
    low, high = torch.tensor(model.scene.bounds).T
    assert positions.isfinite().all()
    assert (positions >= low - 1e-5).all()
    assert (positions <= high + 1e-5).all()
    test = model.card["test"]
    assert test["mse"] < min(test["still/mse"], test["free_fall/mse"])
    assert (shipped_folder("zoo") / name / "README.md").is_file()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["rollout", "nothing"], "holds no model"),
        (["rollout", "nothing", "--frames", "0"], "--frames 0: it must be at least 1"),
        (["rollout", "nothing", "--out", "no/where.h5"], "does not exist"),
        (["render", "nothing.h5"], "nothing.h5"),
        (["zoo", "add", "nowhere", "mine"], "not a finished run"),
        (["zoo", "card", "nothing"], "holds no model"),
    ],
)
def test_mistakes_get_one_line(words, complaint, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 1
    assert complaint in capsys.readouterr().err
