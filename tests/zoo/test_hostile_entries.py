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
from nmpm.zoo.entries import CELLS, read_recipe
from nmpm.zoo.registry import load_model
from tests.data.fuzzing import FUZZ, VALUES, changed, places

REFUSALS = (ZooError, DataError, ConfigError)


def refuse_or_load(path) -> str:
    """The message of an entry or checkpoint that is refused, in which its folder counts for nothing."""
    try:
        load_model(path)
    except REFUSALS as error:
        message = str(error).replace(str(path.parent), "")
        assert "\n" not in message
        assert len(message) < 900
        return message
    return ""


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
        ({"processor__class_path": "a" * 100_000}, "is not known"),
        ({"processor__init_args": ["width"]}, "must map keys to values"),
        ({"decoder__" + "x" * 100_000: 1}, "has the unknown keys xxx"),
        ({"scene__dt": float("inf")}, "dt: inf is not finite"),
        ({"scene": None}, "config.yaml does not describe a model"),
        ({"scene__bounds": [[False, True], [0, 1]]}, "should be a list, each [a finite number, a finite number]"),
        ({"constraints": {"energy": "x" * 100_000, "bounds": "no" * 100_000}}, "energy = 'xxx"),
    ],
)
def test_recipes_of_impossible_models(root, values, message):
    change(root, **values)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert message in refuse_or_load(root / "small")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 * 2**10  # KiB


def test_pipes_alias_bombs_and_weights_of_too_many_bytes(root, monkeypatch):
    path = root / "small" / "config.yaml"
    lines = ["a0: &a0 [x, x]", *(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]" for i in range(1, 40))]
    path.write_text("\n".join(lines))
    assert "aliases repeat too much" in refuse_or_load(root / "small")
    path.unlink()
    os.mkfifo(path)
    assert "not a regular file" in refuse_or_load(root / "small")
    monkeypatch.setattr("nmpm.zoo.entries.WEIGHT_BYTES", 100)
    assert "more than 100 bytes" in refuse_or_load(root / "small")


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
        ({"input_mean": torch.full((4, 1, 1), float("inf"))}, "input_mean holds values that are not finite"),
    ],
)
def test_weights_of_other_models(root, small, write_entry, changes, message):
    write_entry(root / "small", small, weights(small, **changes))
    assert message in refuse_or_load(root / "small")


def header(**tensors) -> bytes:
    text = json.dumps(tensors).encode()
    return struct.pack("<Q", len(text)) + text


@pytest.mark.parametrize(
    "content",
    [
        struct.pack("<Q", 2**63) + b"{}",
        header(w={"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}),
        pickle.dumps({"a": 1}),
    ],
    ids=["size", "offsets", "pickle"],
)
def test_headers_that_lie(root, small, write_entry, content):
    write_entry(root / "small", small, content)
    assert "model.safetensors" in refuse_or_load(root / "small")


def test_the_limits_allow_large_models(small):
    large = small.recipe.to_dict()
    large["cells"] = [4096, 4096]
    large["processor"]["init_args"]["width"] = 512
    assert read_recipe(large).grid.size == CELLS


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


@pytest.mark.slow
@pytest.mark.parametrize("file", ["config.yaml", "card.yaml", "a.ckpt"])
def test_any_value_anywhere(root, checkpoint, file):
    path = root / "small" / file
    plain = {} if file == "a.ckpt" else yaml.safe_load(path.read_text())
    where = checkpoint.places if file == "a.ckpt" else sorted(places(plain), key=str)

    @FUZZ
    @given(st.sampled_from(where), VALUES)
    def check(place, value):
        if file == "a.ckpt":
            refuse_or_load(checkpoint(place, value))
        else:
            path.write_text(yaml.safe_dump(changed(plain, place, value), allow_unicode=False))
            refuse_or_load(root / "small")

    check()


@pytest.mark.slow
@pytest.mark.parametrize("file", ["config.yaml", "card.yaml", "model.safetensors", "a.ckpt"])
def test_any_bytes_anywhere(root, small, write_entry, checkpoint, file):
    path = checkpoint() if file == "a.ckpt" else root / "small" / file
    content = path.read_bytes()
    end = struct.unpack("<Q", content[:8])[0] + 100 if file == "model.safetensors" else len(content)

    @FUZZ
    @given(
        st.integers(0, end),
        st.integers(0, 40),
        st.binary(max_size=12) | st.text("&*!-[]{}:,\n 0e.'\"?|>%@").map(str.encode),
    )
    def check(start, removed, added):
        damaged = content[:start] + added + content[start + removed :]
        if file == "model.safetensors":
            write_entry(root / "small", small, damaged)
        else:
            path.write_bytes(damaged)
        refuse_or_load(path if file == "a.ckpt" else root / "small")

    check()


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("cells",), [8192, 8192], "are more than 16,777,216"),
        (("processor", "init_args", "width"), 10**6, "more than 1,000,000,000 parameters"),
    ],
)
def test_checkpoints_of_impossible_models(checkpoint, place, value, message):
    with pytest.raises(ConfigError, match=message):
        load_model(checkpoint(("hyper_parameters", *place), value))
