"""Cards are measured again and agree; changed weights, statistics and figures are noticed."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from nmpm._support.shipped import shipped_folder
from nmpm.cli import main
from nmpm.errors import ConfigError, ZooError
from nmpm.evaluation.bootstrap import interval
from nmpm.sim import load_preset
from nmpm.sim.predictability import twin_of
from nmpm.zoo import Zoo
from nmpm.zoo.choice import stated_milliseconds
from nmpm.zoo.golden import TOLERANCE, golden_distance
from nmpm.zoo.index import refresh, write_index
from nmpm.zoo.lifecycle import lifecycle
from nmpm.zoo.measures.simulator import measure_twin
from nmpm.zoo.scenes import iterate_test_scenes
from nmpm.zoo.verification import Check, verify

SHIPPED = shipped_folder("zoo")
SIMULATED = [name for name in Zoo.list(SHIPPED) if ", simulated by nmpm" in Zoo.card(name, SHIPPED)["dataset"]]


@pytest.mark.parametrize("name", Zoo.list(SHIPPED))
def test_every_shipped_card_states_a_golden_rollout_that_the_model_repeats(name):
    assert golden_distance(Zoo.load(name, SHIPPED), Zoo.card(name, SHIPPED)["golden"]) < TOLERANCE
    assert Zoo.card(name, SHIPPED)["lifecycle"] == lifecycle(Zoo.card(name, SHIPPED))


@pytest.mark.parametrize("name", SIMULATED)
def test_errors_of_shipped_models_are_measured_again_from_the_seeds_of_their_test_scenes(name):
    checks = list(verify(Zoo.load(name, SHIPPED)))
    assert len(checks) >= 4
    assert [str(check) for check in checks if not check.passed] == []


def test_errors_on_recorded_data_are_measured_again_where_the_data_are(recorded):
    model = Zoo.load("waterdrop", SHIPPED)
    assert all(check.passed for check in verify(model, data=recorded / "deepmind-waterdrop"))
    with pytest.raises(ConfigError, match="recorded data"):
        list(verify(model))


def changed(model, change):
    """The same model after a change of its tensors."""
    emulator = model.emulator.rebuilt(model.emulator.recipe)
    change(emulator)
    return dataclasses.replace(model, emulator=emulator.eval())


@pytest.mark.parametrize(
    "change",
    [
        lambda emulator: emulator.input_std.mul_(1.1),
        lambda emulator: emulator.output_scale.mul_(1.1),
        lambda emulator: next(emulator.processor.parameters()).data.zero_(),
    ],
    ids=["input scale", "output scale", "a layer"],
)
def test_statistics_that_are_not_applied_and_layers_that_are_lost_are_noticed(change):
    model = changed(Zoo.load("goop", SHIPPED), change)
    checks = list(verify(model))
    assert not checks[0].passed
    assert not all(check.passed for check in checks[1:])


def test_a_card_that_states_other_errors_fails_from_the_shell(tmp_path, capsys):
    copy = tmp_path / "zoo" / "goop"
    copy.mkdir(parents=True)
    for path in (SHIPPED / "goop").glob("*.*"):
        (copy / path.name).write_bytes(path.read_bytes())
    words = ["zoo", "--root", str(tmp_path / "zoo"), "verify", "goop"]
    assert main(words) == 0
    assert "All that was measured is confirmed" in capsys.readouterr().out
    card = yaml.safe_load((copy / "card.yaml").read_text())
    card["per_trajectory"][0]["mse@32"] *= 0.5
    card["test"]["mse@32"] = float(np.mean([row["mse@32"] for row in card["per_trajectory"]]))
    (copy / "card.yaml").write_text(yaml.safe_dump(card))
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "FAIL  test scene 0, mse@32" in out
    assert "1 figures are not confirmed" in out


def test_headline_figures_are_the_means_of_those_of_the_scenes():
    model = Zoo.load("goop", SHIPPED)
    test = dict(model.card["test"])
    for name in ("mse", "mse@100"):
        other = dataclasses.replace(model, card=model.card | {"golden": None, "test": test | {name: 0.9 * test[name]}})
        failed = [check.name for check in verify(other) if not check.passed]
        assert failed == [f"test {name}, as the mean over the card's 30 test scenes"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"golden": {"seed": 0}}, "golden rollout of its card cannot be read: KeyError"),
        ({"golden": 5}, "golden rollout of its card cannot be read"),
        (
            {"golden": {"seed": float("inf"), "count": 300, "frames": 32, "position": []}},
            "cannot be read: OverflowError",
        ),
        ({"golden": {"seed": 0, "count": 10**6, "frames": 32, "position": [[1, 2]] * 8}}, "cannot be repeated"),
        ({"per_trajectory": None}, "states no errors of single test scenes"),
        ({"golden": {"seed": 0, "count": 300, "frames": 32, "position": [[1, 2]]}}, "8 positions in 2 dimensions"),
        ({"golden": {"seed": 0, "count": 300, "frames": 10**9, "position": [[1, 2]] * 8}}, "up to 32 frames"),
        ({"per_trajectory": [5]}, "should list the figures of each test scene"),
        ({"per_trajectory": [{}]}, "should list the figures of each test scene"),
        ({"per_trajectory": [{"mse@8": "x"}]}, "should list the figures of each test scene"),
        ({"per_trajectory": [{"mse": 1e-9}] * 30, "test": {"mse": 1e-9}}, "no error of a test scene that was measured"),
        ({"test": {}}, "test of its card should state figures"),
        ({"test": None}, "test of its card should state figures"),
        ({"simulation": {}}, "simulation of its card cannot be read: KeyError"),
        ({"simulation": {"preset": "x"}}, "simulation of its card cannot be read: ValueError"),
        ({"simulation": "x"}, "simulation of its card cannot be read: TypeError"),
    ],
    ids=str,
)
def test_malformed_cards_are_not_confirmed(change, message):
    model = Zoo.load("goop", SHIPPED)
    quick = {} if "golden" in change else {"golden": None}
    with pytest.raises(ZooError, match=message):
        list(verify(dataclasses.replace(model, card=model.card | quick | change)))


def test_a_folder_with_other_test_scenes_than_the_cards_is_refused(make_dataset):
    model = Zoo.load("goop", SHIPPED)
    with pytest.raises(ConfigError, match="has other test scenes than the card of goop is of"):
        next(iterate_test_scenes(model, 10, make_dataset()))


@pytest.mark.slow
def test_full_verification_compares_means_with_their_intervals():
    card = Zoo.card("goop", SHIPPED)
    few = dataclasses.replace(
        Zoo.load("goop", SHIPPED), card=card | {"per_trajectory": card["per_trajectory"][:3], "golden": None}
    )
    checks = [check for check in verify(few, full=True) if not check.name.startswith("test ")]
    assert [check.name.split()[0] for check in checks] == ["mse@8", "mse@32", "mse@100", "mse"]
    assert all(check.passed for check in checks)


def test_a_check_passes_at_its_limits_and_not_with_nan():
    assert Check("", 1.0, 1.1, 0.9, 1.1).passed
    assert not Check("", 1.0, float("nan"), 0.9, 1.1).passed


def test_the_interval_of_a_mean_covers_it_as_often_as_it_says():
    rng = np.random.default_rng(1)
    covered = [low <= 1.0 <= high for low, high in (interval(rng.normal(1, 1, 40)) for _ in range(200))]
    assert 0.88 < np.mean(covered) < 0.99
    assert interval([2.0]) == (2.0, 2.0)


@pytest.mark.parametrize(
    ("card", "state"),
    [
        ({"test": {"mse": 0.1, "still/mse": 0.4, "free_fall/mse": 0.5}}, "active"),
        ({"test": {"mse": 0.1, "still/mse": 0.5, "free_fall/mse": 0.39}}, "preview"),
        ({"test": {"mse": 0.1}}, "preview"),
        ({"test": {"mse": float("nan"), "still/mse": 0.5}}, "preview"),
        ({}, "preview"),
        ({"test": {"mse": 0.1, "still/mse": 0.5}, "superseded_by": "other"}, "superseded"),
    ],
)
def test_the_lifecycle_follows_from_the_figures(card, state):
    assert lifecycle(card) == state


def test_a_zoo_is_refreshed_and_its_table_names_every_model(root, capsys):
    curve = [[60.0, 10, 0.5], [120.0, 20, 0.4]]
    path = root / "small" / "card.yaml"
    card = yaml.safe_load(path.read_text()) | {
        "test": {"mse": 0.1, "still/mse": 1.0, "free_fall/mse": 2.0, "mse@100": 0.01},
        "per_trajectory": [{"mse": 0.05, "mse@100": 0.01}, {"mse": 0.15, "mse@100": 0.01}],
        "training": {"steps": 20, "seconds": 7200.0, "hardware": "a CPU", "precision": "32-true", "parameters": 1},
        "curve": curve,
        "goal": 0.08,
    }
    path.write_text(yaml.safe_dump(card))
    (root / "small" / "errors.csv").write_text("frame,model,still,free_fall\n1,0.1,0.2,0.3\n2,0.2,0.3,0.4\n")
    assert main(["zoo", "refresh", "--measure", "speed", "--root", str(root)]) == 0
    again = yaml.safe_load(path.read_text())
    assert (again["lifecycle"], again["format"]) == ("active", 1)
    assert golden_distance(Zoo.load("small", root), again["golden"]) == 0
    speed = again["speed"][0]
    assert speed["ms_per_frame"] > 0
    counted = Path("/proc/self/clear_refs").exists()
    assert all((speed[name] is not None) == counted for name in ("memory_mb", "best_memory_mb"))
    text = (root / "README.md").read_text()
    assert "| [small](small/README.md) | active | made up | 100 | 50 – 150 | 80 | 10 |  | 1e+03 | 2.0 h |" in text
    card_text = (root / "small" / "README.md").read_text()
    assert "![errors over frames and over training](chart.png)" in card_text
    assert "| model, 95% over scenes |" in card_text
    emulator = Zoo.load("small", root).emulator
    torch.testing.assert_close(emulator.input_std, torch.full_like(emulator.input_std, 2.0))
    golden = again["golden"] | {"position": [[0.0, 0.0] for _ in range(8)]}
    path.write_text(yaml.safe_dump(again | {"golden": golden}))
    refresh(root / "small")
    assert yaml.safe_load(path.read_text())["golden"] == golden  # it would hide a change
    (root / "broken").mkdir()
    (root / "broken" / "card.yaml").write_text("{")
    assert "broken" not in write_index(root).read_text()


@pytest.fixture
def variants(root, small, write_entry) -> Path:
    """Three variants: accurate and slow, in between, fast."""
    for name, mse, milliseconds in (("accurate", 0.1, 9.0), ("balanced", 0.2, 3.0), ("fast", 0.4, 1.0)):
        speed = [{"hardware": "a GPU", "ms_per_frame": milliseconds}]
        write_entry(root / "pond" / name, small, test={"mse": mse}, speed=speed)
    return root


@pytest.mark.parametrize(
    ("limits", "chosen"),
    [
        ({"variant": "fast"}, "fast"),
        ({"max_ms_per_frame": 5.0, "hardware": "a GPU"}, "balanced"),
        ({"max_mse": 0.3, "hardware": "a GPU"}, "balanced"),
        ({"max_mse": 0.3}, "accurate"),  # without times, the most accurate
        ({"max_ms_per_frame": 1e9, "calibrate": True}, "accurate"),
    ],
    ids=str,
)
def test_a_variant_is_chosen_by_name_error_or_time(variants, limits, chosen):
    assert Zoo.load("pond", variants, **limits).card["test"] == Zoo.card(f"pond/{chosen}", variants)["test"]


def test_times_of_cards_of_earlier_versions_count_for_the_same_processor():
    card = {"speed": [{"hardware": "AMD EPYC, 1 threads", "ms_per_frame": 2.0}]}
    assert stated_milliseconds(card, "AMD EPYC, 1 thread") == 2.0
    assert stated_milliseconds(card, "AMD EPYC, 11 threads") is None
    assert stated_milliseconds({"speed": [{"ms_per_frame": 2.0}]}, "AMD EPYC, 1 thread") is None


def test_limits_that_no_variant_keeps_or_no_card_states_are_named(variants):
    with pytest.raises(Exception, match=r"within the limits\. .*pond/fast: MSE 0\.4, 1 ms"):
        Zoo.load("pond", variants, max_ms_per_frame=0.5, hardware="a GPU")
    with pytest.raises(Exception, match=r"state no time on this machine, but on a GPU .*calibrate=True"):
        Zoo.load("pond", variants, max_ms_per_frame=5.0)
    with pytest.raises(Exception, match=r"holds no model 'pnd'.*Did you mean pond"):
        Zoo.load("pnd", variants, max_mse=0.5)


def test_a_twin_has_half_the_substeps_where_that_is_stable_and_differs_little():
    assert twin_of(load_preset("waterramps")).substeps == 13
    dam, blocks = load_preset("dambreak2d"), load_preset("wbcsph")
    assert twin_of(dam).substeps == dam.stable_substeps > 50  # half as many are too few for sound
    assert twin_of(blocks).substeps == 2 * blocks.substeps  # there is no choice
    model = Zoo.load("goop", SHIPPED)
    preset = load_preset("goop").with_frames(40)
    simulation = {"preset": preset.to_dict(), "counts": {"train": 0, "valid": 0, "test": 1}, "seed": 0}
    stated = simulation | {"revision": preset.revision}
    short = dataclasses.replace(model, card=model.card | {"simulation": stated})
    twin = measure_twin(short)
    assert 0 < twin.errors["mse"] < model.card["test"]["mse@100"]
    assert "mse@100" not in twin.errors
    for later in (stated | {"revision": -1}, None):
        other = dataclasses.replace(model, card=model.card | {"simulation": later, "dataset": "recorded"})
        with pytest.raises(ConfigError, match=r"revision -1|recorded data"):
            measure_twin(other)
