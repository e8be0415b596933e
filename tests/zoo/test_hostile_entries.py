"""Malicious or damaged entries: each gives one short error, soon and without much memory."""

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


def complaint(root) -> str:
    """The message for the entry `small`, in which the folder counts for nothing."""
    with pytest.raises(ZooError) as caught:
        Zoo.load("small", root)
    message = str(caught.value).replace(str(root), "")
    assert "\n" not in message
    assert len(message) < 900
    return message


def change(root, **values) -> None:
    """Set values of config.yaml, keys of nested mappings joined by two underscores."""
    path = root / "small" / "config.yaml"
    config = yaml.safe_load(path.read_text())
    for key, value in values.items():
        *outer, last = key.split("__")
        place = config
        for name in outer:
            place = place[name]
        place[last] = value
    path.write_text(yaml.safe_dump(config))


POINTWISE = {"class_path": "nmpm.processors.Pointwise", "init_args": {"hidden": [1] * 20_000}}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"cells": 10**9}, "cells: an integer is larger than 16,777,216"),
        ({"cells": [8192, 8192]}, "cells: 67,108,864 are more than 16,777,216"),
        ({"frames": 10**6}, "frames: 1,000,000 are more than 4,096"),
        ({"processor": POINTWISE}, "processor: its network has more than 5,000 tensors"),
        ({"processor__init_args__width": 10**6}, "processor: its network has more than 1,000,000,000 parameters"),
        ({"processor__init_args__depth": 10**12}, "depth: an integer is larger"),
        ({"processor__class_path": "a" * 100_000}, "is not known"),
        ({"processor__init_args": ["width"]}, "must map keys to values"),
        ({"processor__width": 8, "decoder__x": 1}, "has the unknown keys width beside class_path and init_args"),
        ({"decoder__" + "x" * 100_000: 1}, "has the unknown keys xxx"),
        ({"scene__dt": float("inf")}, "dt: inf is not finite"),
        ({"scene__materials": [f"m{i}" for i in range(30_000)]}, "more than 5,000 modules"),
        ({"scene": None}, "config.yaml does not describe a model"),
        (
            {"scene__bounds": [["0", "1"], ["0", "1"]]},
            "scene: bounds = [['0', '1'], ['0', '1']] should be a list, each",
        ),
        ({"scene__bounds": [[False, True], [0, 1]]}, "should be a list, each [a finite number, a finite number]"),
        ({"scene__gravity_varies": "no"}, "scene: gravity_varies = 'no' should be true or false"),
        ({"processor__init_args__width": 8.0}, "UNet: width = 8.0 should be a whole number"),
        ({"constraints": {"energy": "x" * 100_000, "bounds": "no" * 100_000}}, "energy = 'xxx"),
        ({"k" * 100_000: 1}, "unknown kkk"),
    ],
)
def test_recipes_of_impossible_models(root, values, message):
    change(root, **values)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert message in complaint(root)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 * 2**10  # KiB


@pytest.mark.parametrize("file", ["card.yaml", "config.yaml", "model.safetensors"])
def test_pipes_in_place_of_files(root, file):
    path = root / "small" / file
    path.unlink()
    os.mkfifo(path)
    assert "not a regular file" in complaint(root)


def test_an_alias_bomb(root):
    lines = ["a0: &a0 [x, x]", *(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]" for i in range(1, 40))]
    for file in ("card.yaml", "config.yaml"):
        (root / "small" / file).write_text("\n".join(lines))
        assert "aliases repeat too much" in complaint(root)


def test_weights_of_too_many_bytes(root, monkeypatch):
    monkeypatch.setattr("nmpm.zoo.entries.WEIGHT_BYTES", 100)
    assert "more than 100 bytes" in complaint(root)


def weights(emulator, **changes) -> bytes:
    tensors = {name: value.contiguous() for name, value in emulator.state_dict().items()} | changes
    return save({name: value for name, value in tensors.items() if value is not None})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"input_mean": None}, "lacks tensors input_mean"),
        ({"k" * 5000: torch.zeros(1)}, "has the unknown tensors kkk"),
        ({"input_mean": torch.zeros(5)}, "input_mean has the shape (5,); the model of config.yaml needs (4, 1, 1)"),
        ({"input_mean": torch.zeros(4, 1, 1).to(torch.float8_e4m3fn)}, "input_mean is of torch.float8_e4m3fn"),
        ({"input_mean": torch.zeros(4, 1, 1, dtype=torch.int64)}, "input_mean is of torch.int64"),
        ({"input_mean": torch.zeros(4, 1, 1, dtype=torch.complex64)}, "input_mean is of torch.complex64"),
        ({"calibrated": torch.zeros(())}, "calibrated is of torch.float32"),
        ({"input_mean": torch.full((4, 1, 1), float("inf"))}, "input_mean holds values that are not finite"),
    ],
)
def test_weights_of_other_models(root, small, write_entry, changes, message):
    write_entry(root / "small", small, weights(small, **changes))
    assert message in complaint(root)


def test_weights_in_half_precision_are_taken(root, small, write_entry):
    write_entry(root / "small", small, weights(small, input_std=small.input_std.bfloat16()))
    model = Zoo.load("small", root)
    assert model.emulator.input_std.dtype == torch.float32
    assert torch.equal(model.emulator.input_std, small.input_std)


def header(**tensors) -> bytes:
    text = json.dumps(tensors).encode()
    return struct.pack("<Q", len(text)) + text


@pytest.mark.parametrize(
    "content",
    [
        b"",
        struct.pack("<Q", 2**63) + b"{}",
        header(w={"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}),
        header(w={"dtype": "F32", "shape": [1], "data_offsets": [4, 0]}),
        struct.pack("<Q", 100_000) + b"[" * 100_000,
        pickle.dumps({"a": 1}),
    ],
)
def test_headers_that_lie(root, small, write_entry, content):
    write_entry(root / "small", small, content)
    assert "model.safetensors" in complaint(root)


def test_the_limits_allow_large_models(small):
    plain = small.recipe.to_dict()
    large = copy.deepcopy(plain)
    large["cells"] = [4096, 4096]
    large["processor"]["init_args"]["width"] = 512
    assert read_recipe(large).grid.size == CELLS
    before = torch.random.get_rng_state()
    read_recipe(plain)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert sum(p.numel() for p in build(read_recipe(plain)).parameters()) == sum(p.numel() for p in small.parameters())


def load(root) -> None:
    try:
        Zoo.load("small", root)
    except (ZooError, DataError, ConfigError) as error:
        message = str(error).replace(str(root), "")
        assert "\n" not in message
        assert len(message) < 900


@pytest.mark.slow
@pytest.mark.parametrize("file", ["config.yaml", "card.yaml"])
def test_any_value_anywhere_in_the_texts(root, file):
    path = root / "small" / file
    plain = yaml.safe_load(path.read_text())
    where = sorted(places(plain), key=str)

    @FUZZ
    @given(st.sampled_from(where), VALUES)
    def check(place, value):
        path.write_text(yaml.safe_dump(changed(plain, place, value), allow_unicode=False))
        load(root)

    check()


@pytest.mark.slow
@pytest.mark.parametrize("file", ["config.yaml", "card.yaml"])
def test_any_bytes_in_the_texts(root, file):
    path = root / "small" / file
    content = path.read_bytes()

    @FUZZ
    @given(
        st.integers(0, len(content)),
        st.integers(0, 40),
        st.binary(max_size=12) | st.text("&*!-[]{}:,\n 0e.'\"?|>%@").map(str.encode),
    )
    def check(start, removed, added):
        path.write_bytes(content[:start] + added + content[start + removed :])
        load(root)

    check()


@pytest.mark.slow
def test_any_bytes_in_the_weights(root, small, write_entry):
    content = (root / "small" / "model.safetensors").read_bytes()
    (size,) = struct.unpack("<Q", content[:8])

    @FUZZ
    @given(st.integers(0, size + 100), st.integers(0, 20), st.binary(max_size=12))
    def check(start, removed, added):
        write_entry(root / "small", small, content[:start] + added + content[start + removed :])
        load(root)

    check()


@pytest.fixture
def checkpoint(tmp_path, small):
    """Writes a checkpoint with changed hyperparameters."""
    module = EmulatorModule.of(small, unroll=2)
    hyperparameters = copy.deepcopy(dict(module.hparams))

    def write(place=(), value=None):
        stored = {"hyper_parameters": hyperparameters}
        stored = changed(stored, place, value) if place else stored
        torch.save({"state_dict": module.state_dict(), "nmpm_format": 1} | stored, tmp_path / "a.ckpt")
        return tmp_path / "a.ckpt"

    write.places = sorted(places({"hyper_parameters": hyperparameters}), key=str)
    return write


def load_checkpoint(path) -> None:
    try:
        load_model(path)
    except (DataError, ConfigError) as error:
        message = str(error).replace(str(path), "")
        assert "\n" not in message
        assert len(message) < 900


@pytest.mark.slow
def test_any_value_anywhere_in_a_checkpoint(checkpoint):
    @FUZZ
    @given(st.sampled_from(checkpoint.places), VALUES)
    def check(place, value):
        load_checkpoint(checkpoint(place, value))

    check()


@pytest.mark.slow
def test_any_bytes_in_a_checkpoint(checkpoint):
    path = checkpoint()
    content = path.read_bytes()

    @FUZZ
    @given(st.integers(0, len(content)), st.integers(0, 20), st.binary(max_size=12))
    def check(start, removed, added):
        path.write_bytes(content[:start] + added + content[start + removed :])
        load_checkpoint(path)

    check()


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("cells",), [8192, 8192], "are more than 16,777,216"),
        (("processor", "init_args", "depth"), 10**12, "an integer is larger"),
        (("processor",), POINTWISE, "more than 5,000 tensors"),
    ],
)
def test_checkpoints_of_impossible_models(checkpoint, place, value, message):
    with pytest.raises(ConfigError, match=message):
        load_model(checkpoint(("hyper_parameters", *place), value))
