"""A variant is chosen by error and time; damaged and unmeasured models of one's own do not hinder it."""

import pytest
import yaml

from nmpm.errors import ConfigError, ZooError
from nmpm.zoo import Zoo
from nmpm.zoo.choice import Limits

GPU = {"hardware": "a GPU"}


@pytest.fixture
def pond(root, small, write_entry):
    """Three variants with times, and beside them one without a time, one without an error and one with a bad card."""
    for name, mse, milliseconds in (("accurate", 0.1, 9.0), ("balanced", 0.2, 3.0), ("fast", 0.4, 1.0)):
        write_entry(root / "pond" / name, small, test={"mse": mse}, speed=[GPU | {"ms_per_frame": milliseconds}])
    write_entry(root / "pond" / "untimed", small, test={"mse": 0.05})
    write_entry(root / "pond" / "malformed", small, test={"mse": 0.06}, speed=[GPU, "x"])
    write_entry(root / "pond" / "unmeasured", small, test=None, speed=[GPU | {"ms_per_frame": 0.1}])
    write_entry(root / "pond" / "diverged", small, test={"mse": float("nan")}, speed=[GPU | {"ms_per_frame": 0.1}])
    write_entry(root / "pond" / "timeless", small, test={"mse": 0.15}, speed=[GPU | {"ms_per_frame": float("nan")}])
    write_entry(root / "pond" / "backwards", small, test={"mse": 0.15}, speed=[GPU | {"ms_per_frame": -1.0}])
    write_entry(root / "pond" / "damaged", small)
    (root / "pond" / "damaged" / "card.yaml").write_text("{")
    return root


@pytest.mark.parametrize(
    ("limits", "chosen"),
    [
        ({"max_ms_per_frame": 5.0}, "balanced"),
        ({"max_mse": 0.3}, "balanced"),
        ({"max_mse": 0.3, "max_ms_per_frame": 20.0}, "accurate"),
        ({"max_mse": 0.07}, "untimed"),  # the most accurate, where none that is accurate enough has a time
    ],
    ids=str,
)
def test_models_without_a_time_or_an_error_and_damaged_ones_are_left_out(pond, limits, chosen):
    found = Zoo.load("pond", pond, **limits, **GPU)
    assert found.card == Zoo.card(f"pond/{chosen}", pond)


def test_a_model_with_damaged_weights_is_not_timed(root, small, write_entry):
    write_entry(root / "pond" / "whole", small, test={"mse": 0.2})
    write_entry(root / "pond" / "damaged", small, test={"mse": 0.1})
    (root / "pond" / "damaged" / "model.safetensors").write_bytes(b"")
    assert Zoo.load("pond", root, max_ms_per_frame=1e9, calibrate=True).card["test"] == {"mse": 0.2}


def test_where_all_cards_are_damaged_one_is_named(root):
    path = root / "small" / "card.yaml"
    path.write_text("{")
    with pytest.raises(ZooError, match=r"card\.yaml cannot be read"):
        Zoo.load("small", root, max_mse=1.0)
    path.write_text(yaml.safe_dump({"format": 1, "test": None}))
    for limit in ("max_mse", "max_ms_per_frame"):
        with pytest.raises(ZooError, match="None states an error"):
            Zoo.load("small", root, **{limit: 1.0})


@pytest.mark.parametrize("limit", ["max_mse", "max_ms_per_frame"])
@pytest.mark.parametrize("value", [0, 0.0, -1, float("nan"), "small", "0.1", True], ids=repr)
def test_limits_are_positive_numbers(limit, value):
    with pytest.raises(ConfigError, match=rf"{limit} = {value!r} must be a positive number"):
        Limits(**{limit: value})


@pytest.mark.parametrize("option", [{"calibrate": True}, {"hardware": "a GPU"}], ids=str)
def test_hardware_and_calibration_need_a_limit(root, option):
    with pytest.raises(ConfigError, match="give max_mse or max_ms_per_frame too"):
        Zoo.load("small", root, **option)


def test_times_are_measured_or_stated(root):
    with pytest.raises(ConfigError, match="hardware = 'a GPU' takes stated times: give one"):
        Zoo.load("small", root, max_mse=1.0, hardware="a GPU", calibrate=True)


@pytest.mark.parametrize("choice", [{"variant": "fast"}, {"max_mse": 1.0}, {"max_ms_per_frame": 1.0}], ids=str)
def test_paths_and_ids_have_no_variants(root, monkeypatch, choice):
    monkeypatch.chdir(root)
    for model in (root / "small", str(root / "small"), "./small", "lab/small@main"):
        with pytest.raises(ConfigError, match="is one model: variant, max_mse and max_ms_per_frame choose among"):
            Zoo.load(model, **choice)


def test_a_folder_with_the_name_of_a_dataset_does_not_hide_its_variants(
    home, small, write_entry, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for folder in (home / "zoo" / "pond" / "fast", tmp_path / "pond"):
        write_entry(folder, small)
    assert Zoo.load("pond", variant="fast").name == "fast"
    assert Zoo.load("pond", max_mse=1.0).name == "fast"


def test_the_variants_of_a_dataset_are_named_where_one_is_not_known(pond):
    with pytest.raises(
        ZooError, match=r"no model 'pond/slow'; .* Of pond it has pond/accurate, pond/backwards, pond/balanced, .*fast"
    ):
        Zoo.load("pond", pond, variant="slow")
    with pytest.raises(ZooError, match="Of goop it has goop, goop/fast"):
        Zoo.load("goop", variant="balanced")
