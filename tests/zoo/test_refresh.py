"""Refreshed entries keep what their cards state and what others write meanwhile; incomplete cards are refused."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import yaml

from nmpm.cli import main
from nmpm.errors import ZooError
from nmpm.zoo import Zoo
from nmpm.zoo import index as module
from nmpm.zoo.entries import writing
from nmpm.zoo.index import add_facts, refresh
from nmpm.zoo.storage import halve

COMPLETE = {
    "test": {"mse": 0.1, "still/mse": 1.0, "free_fall/mse": 2.0},
    "per_trajectory": [{"mse": 0.1}],
    "training": {"steps": 20, "seconds": 7200.0, "hardware": "a CPU", "precision": "32-true", "parameters": 1},
}


@pytest.fixture
def entry(root, small, write_entry):
    return write_entry(root / "small", small, **COMPLETE)


@pytest.fixture
def replaced(entry, small, write_entry):
    """Replaces the entry by one of other weights, and returns its card."""

    def replace(*_args):
        small.input_std.fill_(3.0)
        write_entry(entry, small, **COMPLETE)
        return {"seed": 0}

    return replace


def test_an_existing_golden_rollout_is_not_computed_again(entry, monkeypatch):
    refresh(entry)
    golden = Zoo.card("small", entry.parent)["golden"]
    monkeypatch.setattr(module, "golden_rollout", lambda _emulator: pytest.fail("computed again"))
    refresh(entry)
    assert Zoo.card("small", entry.parent)["golden"] == golden


def test_an_entry_that_is_replaced_meanwhile_keeps_its_own_card(entry, replaced, monkeypatch):
    monkeypatch.setattr(module, "golden_rollout", replaced)
    with pytest.raises(ZooError, match="were replaced while the golden rollout was measured; measure it again"):
        refresh(entry)
    assert "golden" not in Zoo.load("small", entry.parent).card  # it can be loaded
    with pytest.raises(ZooError, match="were replaced"):
        add_facts(entry, "0" * 64, {"twin": {}})


def test_facts_that_are_written_at_the_same_time_all_stay(entry):
    weights = Zoo.card("small", entry.parent)["sha256"]
    start = threading.Barrier(6)

    def write(number: int) -> None:
        start.wait()
        add_facts(entry, weights, {f"fact{number}": number})

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(write, range(6)))
    card = Zoo.card("small", entry.parent)
    assert [card.get(f"fact{number}") for number in range(6)] == list(range(6))
    assert not list(entry.parent.glob("**/.*"))


def test_a_variant_is_not_written_while_its_dataset_is(entry):
    reached, done = threading.Event(), []

    def write() -> None:
        reached.set()
        with writing(entry / "fast"):
            done.append("variant")

    with ThreadPoolExecutor(1) as pool:
        with writing(entry):
            future = pool.submit(write)
            reached.wait()
            time.sleep(0.1)
            done.append("dataset")
        future.result()
    assert done == ["dataset", "variant"]


def test_text_that_could_not_be_read_again_is_not_written(entry):
    before = (entry / "card.yaml").read_bytes()
    with pytest.raises(ZooError, match=r"card.yaml: 'Late \\x96 dust' has a control character"):
        refresh(entry, failures="Late \x96 dust")
    assert (entry / "card.yaml").read_bytes() == before


def test_times_of_other_hardware_that_are_written_during_the_measurement_stay(entry, monkeypatch):
    elsewhere = {"hardware": "a GPU", "particles": 9, "ms_per_frame": 1.0, "best_batch": 1, "best_ms_per_frame": 1.0}

    def measure(model):
        add_facts(entry, model.card["sha256"], {"speed": [elsewhere]})
        return elsewhere | {"hardware": "a CPU"}

    monkeypatch.setattr("nmpm.zoo.speed.measure_speed", measure)
    refresh(entry, ["speed"])
    assert [time["hardware"] for time in Zoo.card("small", entry.parent)["speed"]] == ["a GPU", "a CPU"]


@pytest.mark.parametrize(
    ("measure", "change", "message"),
    [
        ("speed", {"particles": "many"}, "particles of its card should be their number, not 'many'"),
        ("quality", {"per_trajectory": []}, "states no errors of single test scenes"),
    ],
)
def test_a_card_that_a_measure_cannot_use_is_named(entry, measure, change, message):
    path = entry / "card.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | change))
    with pytest.raises(ZooError, match=message):
        refresh(entry, [measure])


def test_weights_that_are_replaced_while_they_are_rounded_stay(entry, replaced, monkeypatch):
    def round_network(emulator):
        return replaced() and emulator.rebuilt(emulator.recipe)

    monkeypatch.setattr("nmpm.zoo.storage.round_network", round_network)
    with pytest.raises(ZooError, match="were replaced"):
        halve(entry)
    assert (Zoo.load("small", entry.parent).emulator.input_std == 3.0).all()


@pytest.mark.parametrize(
    ("change", "errors"),
    [
        ({"training": None}, ""),
        ({"test": None}, ""),
        ({"speed": [{"hardware": "x"}]}, ""),
        ({"speed": ["x"]}, ""),
        ({"curve": [[1]]}, ""),
        ({"curve": [["a", "b", "c"]]}, ""),
        ({}, "frame,model\nx,y\n"),
        ({}, "frame,model\n1,0.1\n"),
        ({}, "frame,model,still,free_fall\n1,0.1,0.2,0.3\n2,0."),
    ],
    ids=str,
)
def test_an_incomplete_card_gets_one_line_and_nothing_is_rewritten(entry, change, errors, capsys):
    path = entry / "card.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"golden": {}} | change))
    if errors:
        (entry / "errors.csv").write_text(errors)
    before = {file: file.read_bytes() for file in entry.rglob("*")}
    assert main(["zoo", "refresh", "small", "--root", str(entry.parent)]) == 1
    said = capsys.readouterr().err
    assert "card.yaml or errors.csv beside it is not complete" in said
    assert said.count("\n") == 1
    assert {file: file.read_bytes() for file in entry.rglob("*")} == before


def test_a_malformed_card_does_not_keep_the_table_from_being_written(entry, small, write_entry):
    write_entry(entry.parent / "odd", small, **COMPLETE | {"test": {"mse": "x"}, "speed": [{}]})
    assert "odd" not in module.write_index(entry.parent).read_text()
