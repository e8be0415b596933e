"""Weights in float16: only the network's, only where a rollout does not notice, and entries stay consistent."""

import pytest
import torch
import yaml
from safetensors.torch import load

from nmpm.cli import main
from nmpm.zoo import Zoo, storage
from nmpm.zoo.golden import golden_distance
from nmpm.zoo.storage import halve, round_network, serialise, stored_precision


def test_the_network_is_stored_in_half_the_bytes_and_statistics_as_they_are(small):
    small.input_std.fill_(1.0001)  # float16 has 1 and 1.001
    rounded = round_network(small)
    stored = load(serialise(rounded))
    for name, value in rounded.state_dict().items():
        assert torch.equal(stored[name].to(value.dtype), value)
        assert (stored[name].dtype == torch.float16) == name.startswith("processor.")
    assert torch.equal(stored["input_std"], small.input_std)
    assert (stored_precision(small), stored_precision(rounded)) == ("float32", "float16")
    weight = next(small.processor.parameters())
    assert not torch.equal(weight, next(rounded.processor.parameters()))  # the original is left as it was


@pytest.mark.parametrize("large", [1e5, -1e5])
def test_weights_beyond_the_range_of_float16_stay(small, large):
    next(small.processor.parameters()).data.view(-1)[0] = large
    assert round_network(small) is small
    assert load(serialise(small))["input_mean"].dtype == torch.float32
    assert stored_precision(small) == "float32"


def test_weights_stay_where_a_rollout_notices(small, monkeypatch):
    monkeypatch.setattr(storage, "NOTICED", 0.0)
    assert round_network(small) is small


def test_an_entry_is_halved_once_and_can_be_loaded_and_verified(root, small, write_entry, capsys):
    training = {"steps": 20, "seconds": 7200.0, "hardware": "a CPU", "precision": "32-true", "parameters": 1}
    write_entry(root / "small", small, training=training, test={"mse": 0.1}, curve=[])
    write_entry(root / "small" / "variant", small)
    folder, before = root / "small", (root / "small" / "model.safetensors").stat().st_size
    assert main(["zoo", "refresh", "small", "--half", "--root", str(root)]) == 0
    assert (folder / "model.safetensors").stat().st_size < 0.7 * before
    card = yaml.safe_load((folder / "card.yaml").read_text())
    assert card["weights"] == "float16"
    assert golden_distance(Zoo.load("small", root), card["golden"]) == 0
    assert Zoo.load("small", root, variant="variant").emulator.frames == small.frames  # what lies within stays
    assert "1 parameters, stored in float16; one run" in (folder / "README.md").read_text()
    assert not halve(folder)
    assert sorted(path.name for path in root.iterdir() if path.name.startswith(".")) == []
