"""Malicious or damaged entries and checkpoints: each gives one short error, soon and without much memory."""

import copy
import json
import os
import pickle
import resource
import struct

import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save

from nmpm.errors import ConfigError, DataError, ZooError
from nmpm.training.module import EmulatorModule
from nmpm.zoo.entries import CELLS, build, read_recipe
from nmpm.zoo.registry import Zoo, load_model
from tests.data.fuzzing import FUZZ, VALUES, changed, places


def complaint(path) -> str:
    """The message for a checkpoint or the entry `small` in a zoo, without the path; empty if it is loaded."""
    try:
        load_model(path) if path.suffix == ".ckpt" else Zoo.load("small", path)
    except (DataError, ConfigError, ZooError) as error:
        kind, message = type(error), str(error).replace(str(path), "")
    else:
        return ""
    assert (kind is ZooError) != (path.suffix == ".ckpt")
    assert "\n" not in message
    assert len(message) < 900
    return message


POINTWISE = {"class_path": "nmpm.processors.Pointwise", "init_args": {"hidden": [1] * 20_000}}
IMPOSSIBLE = [
    (("cells",), [8192, 8192], "cells: 67,108,864 are more than 16,777,216"),
    (("frames",), 10**6, "frames: 1,000,000 are more than 4,096"),
    (("processor",), POINTWISE, "processor: its network has more than 5,000 tensors"),
    (("processor", "init_args", "width"), 10**6, "processor: its network has more than 1,000,000,000 parameters"),
    (("processor", "init_args", "depth"), 10**12, "depth: an integer is larger"),
    (("scene", "dt"), float("inf"), "dt: inf is not finite"),
    (("scene", "materials"), [f"m{i}" for i in range(30_000)], "more than 5,000 modules"),
    (("scene",), None, "does not describe a model"),
    (("scene", "bounds"), [["0", "1"], ["0", "1"]], "scene: bounds = [['0', '1'], ['0', '1']] should be a list, each"),
    (("processor", "init_args", "width"), 8.0, "UNet: width = 8.0 should be a whole number"),
    (("decoder", "x" * 100_000), 1, "has the unknown keys xxx"),
    (("constraints",), {"energy": "x" * 100_000, "bounds": "no" * 100_000}, "energy = 'xxx"),
]


def short(value) -> str:
    return str(value)[:30]


@pytest.mark.parametrize(("place", "value", "message"), IMPOSSIBLE, ids=short)
def test_recipes_of_impossible_models(root, place, value, message):
    path = root / "small" / "config.yaml"
    path.write_text(yaml.safe_dump(changed(yaml.safe_load(path.read_text()), place, value)))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert message in complaint(root)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 * 2**10  # KiB


def test_files_that_are_pipes_too_large_or_full_of_aliases(root, monkeypatch):
    bomb = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))
    with monkeypatch.context() as patch:
        patch.setattr("nmpm.zoo.entries.WEIGHT_BYTES", 100)
        assert "more than 100 bytes" in complaint(root)
    for file in ("model.safetensors", "config.yaml", "card.yaml"):
        path = root / "small" / file
        whole = path.read_bytes()
        if file.endswith(".yaml"):
            path.write_text(bomb)
            assert "aliases repeat too much" in complaint(root)
        path.unlink()
        os.mkfifo(path)
        assert "not a regular file" in complaint(root)
        path.unlink()
        path.write_bytes(whole)


HEADER = json.dumps({"w": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()


def weights(emulator, **changes) -> bytes:
    tensors = {name: value.contiguous() for name, value in emulator.state_dict().items()} | changes
    return save({name: value for name, value in tensors.items() if value is not None})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (b"", "model.safetensors is not a file of tensors"),
        (pickle.dumps(print), "model.safetensors is not a file of tensors"),
        (struct.pack("<Q", 2**63) + b"{}", "model.safetensors is not a file of tensors"),
        (struct.pack("<Q", len(HEADER)) + HEADER, "model.safetensors is not a file of tensors"),
        ({"input_mean": None}, "lacks tensors input_mean"),
        ({"k" * 5000: torch.zeros(1)}, "has the unknown tensors kkk"),
        ({"input_mean": torch.zeros(5)}, "input_mean has the shape (5,); the model of config.yaml needs (4, 1, 1)"),
        ({"input_mean": torch.zeros(4, 1, 1, dtype=torch.complex64)}, "input_mean is of torch.complex64"),
        ({"calibrated": torch.zeros(())}, "calibrated is of torch.float32"),
        ({"input_mean": torch.full((4, 1, 1), float("inf"))}, "input_mean holds values that are not finite"),
    ],
    ids=["empty", "pickle", "length", "header", "missing", "unknown", "shape", "complex", "real", "infinite"],
)
def test_weights_that_lie_or_are_of_other_models(root, small, write_entry, changes, message):
    write_entry(root / "small", small, changes if isinstance(changes, bytes) else weights(small, **changes))
    assert message in complaint(root)


def test_weights_in_half_precision_are_taken(root, small, write_entry):
    write_entry(root / "small", small, weights(small, input_std=small.input_std.bfloat16()))
    model = Zoo.load("small", root)
    assert model.emulator.input_std.dtype == torch.float32
    assert torch.equal(model.emulator.input_std, small.input_std)


def test_the_limits_allow_large_models(small):
    plain = small.recipe.to_dict()
    large = changed(changed(plain, ("cells",), [4096, 4096]), ("processor", "init_args", "width"), 512)
    assert read_recipe(large).grid.size == CELLS
    before = torch.random.get_rng_state()
    read_recipe(plain)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert sum(p.numel() for p in build(read_recipe(plain)).parameters()) == sum(p.numel() for p in small.parameters())


@pytest.fixture
def write_checkpoint(tmp_path, small):
    """Writes a checkpoint with changed hyperparameters."""
    module = EmulatorModule.of(small, unroll=2)
    stored = {"hyper_parameters": copy.deepcopy(dict(module.hparams))}

    def write(place=(), value=None):
        content = changed(stored, place, value) if place else stored
        torch.save({"state_dict": module.state_dict(), "nmpm_format": 1} | content, tmp_path / "a.ckpt")
        return tmp_path / "a.ckpt"

    write.stored = stored
    return write


@pytest.mark.parametrize(("place", "value", "message"), [IMPOSSIBLE[0], IMPOSSIBLE[2], IMPOSSIBLE[4]], ids=short)
def test_checkpoints_of_impossible_models(write_checkpoint, place, value, message):
    assert message in complaint(write_checkpoint(("hyper_parameters", *place), value))


@pytest.mark.slow
@pytest.mark.parametrize("file", ["config.yaml", "card.yaml", "a.ckpt"])
def test_any_value_anywhere(root, write_checkpoint, file):
    path = root / "small" / file
    plain = write_checkpoint.stored if file == "a.ckpt" else yaml.safe_load(path.read_text())

    @FUZZ
    @given(st.sampled_from(sorted(places(plain), key=str)), VALUES)
    def check(place, value):
        if file != "a.ckpt":
            path.write_text(yaml.safe_dump(changed(plain, place, value), allow_unicode=False))
        complaint(write_checkpoint(place, value) if file == "a.ckpt" else root)

    check()


@pytest.mark.slow
@pytest.mark.parametrize("file", ["config.yaml", "card.yaml", "model.safetensors", "a.ckpt"])
def test_any_bytes(root, small, write_entry, write_checkpoint, file):
    path = write_checkpoint() if file == "a.ckpt" else root / "small" / file
    content = path.read_bytes()
    end = struct.unpack("<Q", content[:8])[0] + 100 if file == "model.safetensors" else len(content)

    @FUZZ
    @given(
        st.integers(0, end), st.integers(0, 40),
        st.binary(max_size=12) | st.text("&*!-[]{}:,\n 0e.'\"?|>%@").map(str.encode),
    )  # fmt: skip
    def check(start, removed, added):
        damaged = content[:start] + added + content[start + removed :]
        if file == "model.safetensors":
            write_entry(root / "small", small, damaged)  # with the card of these bytes
        else:
            path.write_bytes(damaged)
        complaint(path if file == "a.ckpt" else root)

    check()
