"""Entries are measured again and agree; changed weights, statistics and figures are noticed."""

import dataclasses

import numpy as np
import pytest
import yaml

from nmpm._support.shipped import shipped_folder
from nmpm.cli import main
from nmpm.emulator.adaptation import adapted
from nmpm.errors import ConfigError, ZooError
from nmpm.evaluation.bootstrap import interval
from nmpm.zoo import Zoo
from nmpm.zoo.card import read_scenes
from nmpm.zoo.measures.scenes import iterate_scenes, simulator_of
from nmpm.zoo.verification import TOLERANCE, golden_distance, verify, verify_entry

SHIPPED = shipped_folder("zoo")
SIMULATED = [name for name in Zoo.list(SHIPPED) if ", simulated by nmpm" in Zoo.card(name, SHIPPED)["dataset"]]


@pytest.mark.parametrize("name", Zoo.list(SHIPPED))
def test_every_shipped_model_repeats_its_golden_rollout(name):
    assert golden_distance(Zoo.load(name, SHIPPED), Zoo.card(name, SHIPPED)["golden"]) < TOLERANCE


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == "goop" else pytest.mark.slow) for n in SIMULATED])
def test_errors_of_shipped_models_are_measured_again_from_the_seeds_of_their_test_scenes(name):
    checks = list(verify_entry(SHIPPED / name))
    assert len(checks) >= 4
    assert [str(check) for check in checks if not check.passed] == []


def test_errors_on_recorded_data_are_measured_again_where_the_data_are(recorded):
    assert all(check.passed for check in verify_entry(SHIPPED / "waterdrop", data=recorded / "deepmind-waterdrop"))
    with pytest.raises(ConfigError, match="recorded data"):
        list(verify_entry(SHIPPED / "waterdrop"))


@pytest.mark.parametrize("name", SIMULATED)
def test_the_simulator_of_a_shipped_model_makes_its_scenes_whatever_the_shipped_preset_has_become(name):
    model = Zoo.load(name, SHIPPED)
    assert simulator_of(model).scene == model.scene


@pytest.mark.parametrize("name", ["input_std", "output_scale"])
def test_statistics_that_are_not_applied_are_noticed(name):
    model = Zoo.load("goop", SHIPPED)
    emulator = adapted(model.emulator, model.emulator.recipe)
    getattr(emulator, name).mul_(1.1)
    assert golden_distance(dataclasses.replace(model, emulator=emulator.eval()), model.card["golden"]) > TOLERANCE


def test_an_entry_that_states_other_errors_fails_from_the_shell(goop, capsys):
    words = ["zoo", "--root", str(goop.parent), "verify", "goop"]
    card = yaml.safe_load((goop / "card.yaml").read_text())
    card["test"]["mse@100"] *= 0.9
    (goop / "card.yaml").write_text(yaml.safe_dump(card))
    first, *rows = (goop / "scenes.csv").read_text().splitlines()
    at = first.split(",").index("mse@8")
    cells = rows[0].split(",")
    cells[at] = str(0.5 * float(cells[at]))
    (goop / "scenes.csv").write_text("\n".join([first, ",".join(cells), *rows[1:]]))
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "FAIL  test mse@100, as the mean over 30 test scenes of scenes.csv" in out
    assert "FAIL  test mse@8, as the mean" in out
    assert "FAIL  test scene 0, rolled out: mse@8" in out
    assert "3 figures are not confirmed" in out


GOLDEN = Zoo.card("goop", SHIPPED)["golden"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"golden": None}, "golden rollout of its card cannot be read"),
        ({"golden": GOLDEN | {"count": 10**6}}, "cannot be repeated"),
        ({"golden": GOLDEN | {"position": [[1, 2]]}}, "8 positions in 2 dimensions"),
        ({"test": {"mse": "x"}}, "test of its card should state figures"),
        ({"simulation": {"preset": "x"}}, "simulation of its card cannot be read: ValueError"),
    ],
    ids=str,
)
def test_malformed_cards_are_not_confirmed(change, message):
    model = Zoo.load("goop", SHIPPED)
    with pytest.raises(ZooError, match=message):
        list(verify(dataclasses.replace(model, card=model.card | change), read_scenes(SHIPPED / "goop")))


@pytest.mark.parametrize("text", ["", "mse\nx\n", "mse\n0.1,0.2\n", "mse,mse@8\n,\n"])
def test_malformed_tables_of_scenes_are_not_confirmed(root, text):
    (root / "small" / "scenes.csv").write_text(text)
    with pytest.raises(ZooError, match="errors of single test scenes"):
        read_scenes(root / "small")


def test_a_folder_with_other_test_scenes_than_the_cards_is_refused(make_dataset):
    with pytest.raises(ConfigError, match="has other test scenes than the card of goop is of"):
        next(iterate_scenes("x", Zoo.load("goop", SHIPPED), make_dataset(), frames=10))


@pytest.mark.slow
def test_full_verification_compares_means_with_their_intervals():
    checks = list(verify(Zoo.load("goop", SHIPPED), read_scenes(SHIPPED / "goop")[:3], full=True))
    checks = [check for check in checks if check.name.startswith("3 test scenes, rolled out: ")]
    assert [check.name.split()[-1] for check in checks] == ["mse@8", "mse@32", "mse@100", "mse"]
    assert all(check.passed for check in checks)


def test_the_interval_of_a_mean_covers_it_as_often_as_it_says():
    rng = np.random.default_rng(1)
    covered = [low <= 1.0 <= high for low, high in (interval(rng.normal(1, 1, 40)) for _ in range(200))]
    assert 0.88 < np.mean(covered) < 0.99
    assert interval([2.0]) == (2.0, 2.0)
