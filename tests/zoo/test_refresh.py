"""Measures, READMEs and tables of entries; what others write meanwhile stays, incomplete cards are refused."""

import csv
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml

from nmpm._support.bounded_files import read_yaml
from nmpm._support.shipped import shipped_folder
from nmpm.cli import main
from nmpm.emulator import members
from nmpm.emulator.digests import weights_digest
from nmpm.errors import ConfigError, UnstableError, ZooError
from nmpm.evaluation.stress import GROUPS, results
from nmpm.evaluation.stress.results import QUICK
from nmpm.evaluation.trade.ranking import Setting, at_equal_error
from nmpm.sim import load_preset
from nmpm.sim.preset import nudge, twin_of
from nmpm.zoo import Zoo, load_model
from nmpm.zoo import refresh as module
from nmpm.zoo.card import lifecycle, preset_of, stated_milliseconds
from nmpm.zoo.measures import simulator
from nmpm.zoo.measures.simulator import NUDGE, floor_facts, twin_facts
from nmpm.zoo.pages import entry_page, index_page
from nmpm.zoo.refresh import add_facts, refresh
from nmpm.zoo.speed_table import replace_table
from nmpm.zoo.verification import verify_entry

SHIPPED = shipped_folder("zoo")
COMPLETE = {
    "test": {"mse": 0.1, "mse@100": 0.01, "still/mse": 1.0, "free_fall/mse": 2.0},
    "interval": {"mse": [0.05, 0.15]},
    "test_scenes": 2,
    "training": {"steps": 20, "seconds": 7200.0, "hardware": "a CPU", "precision": "32-true", "parameters": 1},
    "constraints": {"energy": True, "bounds": "stop"},
    "obstacles": False,
    "particles": 50,
}


@pytest.fixture
def entry(root, small, write_entry) -> Path:
    return write_entry(root / "small", small, **COMPLETE)


@pytest.fixture
def goop(goop) -> Path:
    """The shipped model with two short test scenes."""
    preset = load_preset("goop").with_frames(10)
    simulation = {"preset": preset.to_dict(), "counts": {"train": 0, "valid": 1, "test": 2}, "seed": 0}
    card = read_yaml(goop / "card.yaml") | {"simulation": simulation | {"revision": preset.revision}}
    (goop / "card.yaml").write_text(yaml.safe_dump(card))
    return goop


def test_quality_floor_twin_and_pictures_are_on_the_card(goop):
    former = (goop / "rollout.png").read_bytes()
    words = ["zoo", "refresh", "goop", "--measure", "quality", "floor", "twin", "--root", str(goop.parent)]
    assert main(words) == 0
    card = Zoo.card("goop", goop.parent)
    quality, floor, twin = card["quality"], card["floor"], card["twin"]
    for name in ("emd", "kinetic", "height", "crowding"):
        mean, low, high = quality[name]
        assert 0 <= low <= mean <= high
    assert 0 < quality["emd"][0] < 0.01  # of a domain of length 1, in the first frames
    assert 0 < floor["mse"] < 1e-2 * quality["worst"]["mse"]
    assert floor["nudge"] == NUDGE
    assert (twin["substeps"], twin["own_substeps"]) == (6, 12)
    assert floor["mse"] < twin["mse"] < card["test"]["mse@100"]
    pictures = [(goop / name).read_bytes() for name in ("rollout.png", "worst.png")]
    assert all(picture[:4] == b"\x89PNG" for picture in pictures)
    assert former != pictures[0] != pictures[1]  # of the first scene, with a title in the other
    text = (goop / "README.md").read_text()
    assert "![the test scene with the largest error](worst.png)" in text
    assert "| the simulator with 6 substeps a frame instead of 12 |" in text
    assert f"(scene {quality['worst']['scene']})" in text


def test_scores_of_members_are_on_the_card_and_confirmed(goop):
    refresh(goop, ["ensemble"])
    ensemble = Zoo.card("goop", goop.parent)["ensemble"]
    assert (ensemble["members"], ensemble["nudge"]) == (8, 0.03)  # the least, as nothing is chaotic so early
    assert set(ensemble["scores"]) == {"density", "front", "height", "kinetic"}
    for scores in ensemble["scores"].values():
        assert scores["interval"][0] <= scores["crps"] <= scores["interval"][1]
        assert 0 <= scores["coverage50"] <= scores["coverage90"] <= 1
    assert load_model(goop).nudge == 0.03
    assert "Fair CRPS ×10⁻³ of 8 members, starts displaced by 0.03 cells" in (goop / "README.md").read_text()
    (goop / "scenes.csv").write_text("mse\n1e-7\n1e-7\n")
    checks = [check for check in verify_entry(goop, full=True) if "CRPS" in check.name]
    assert len(checks) == 4
    assert all(check.passed for check in checks)


def test_members_are_scored_where_data_have_no_validation_scenes(entry, make_dataset):
    folder = make_dataset(test=((12, 9),), valid=())
    refresh(entry, ["ensemble"], data=folder)
    assert Zoo.card("small", entry.parent)["ensemble"]["nudge"] == members.NUDGE


def nudge_all_but(stable: set[int]):
    """`nudge`, unstable in all scenes but these."""
    scenes = iter(range(2))

    def nudge_or_fail(preset, state, size, seed):
        if next(scenes) not in stable:
            raise UnstableError("The simulation has blown up.")
        return nudge(preset, state, size, seed)

    return nudge_or_fail


def test_scenes_that_are_unstable_are_named(goop, monkeypatch):
    model = load_model(goop)
    monkeypatch.setattr(simulator, "nudge", nudge_all_but({1}))
    assert main(["zoo", "refresh", "goop", "--measure", "floor", "--root", str(goop.parent)]) == 0
    assert Zoo.card("goop", goop.parent)["floor"]["unstable"] == [0]
    assert "Test scenes 0, which this makes unstable, are left out." in (goop / "README.md").read_text()
    monkeypatch.setattr(simulator, "nudge", nudge_all_but(set()))
    with pytest.raises(UnstableError, match="all test scenes of goop unstable"):
        floor_facts(model, None)


def test_a_twin_needs_the_revision_of_the_simulator_that_made_the_data(goop):
    dam, blocks = load_preset("dambreak2d"), load_preset("wbcsph")
    assert twin_of(dam).substeps == dam.stable_substeps > 50  # half as many are too few for sound
    assert twin_of(blocks).substeps == 2 * blocks.substeps  # there is no choice
    card = Zoo.card("goop", goop.parent)
    for simulation, message in ((card["simulation"] | {"revision": -1}, "revision -1"), (None, "recorded data")):
        add_facts(goop, card["sha256"], {"simulation": simulation})
        with pytest.raises(ConfigError, match=message):
            twin_facts(load_model(goop), None)


@pytest.mark.parametrize(("measure", "size"), [("stress", "quick"), ("invariants", "quick, without the simulator")])
def test_stress_tests_are_counted_and_settling_is_simulated_once(entry, monkeypatch, measure, size):
    settled = []

    def long(subject, effort):
        assert effort is QUICK
        assert subject.preset is None or measure == "stress"
        yield results.TestResult("long", "energy", False, {}, "")
        yield results.TestResult("long", "speed", None, {}, "")

    def settle(subject, effort):
        settled.append(subject)
        yield results.TestResult("settling", "with constraints", True, {}, "")
        yield results.TestResult("settling", "without constraints", False, {}, "")

    monkeypatch.setattr(GROUPS, "built_in", {"long": long, "settling": settle})
    monkeypatch.setattr(GROUPS, "_loaded", {})
    refresh(entry, [measure])
    card = Zoo.card("small", entry.parent)
    assert len(settled) == 1
    free = ["long: energy", "settling: without constraints"]
    assert card["stress"] == {"size": size, "passed": 1, "failed": free}
    assert card["stress_free"] == {"size": size, "passed": 0, "failed": free}


def test_the_speed_is_measured_on_the_device_that_is_given(entry, monkeypatch):
    devices = []
    monkeypatch.setattr("nmpm.zoo.pretrained.Pretrained.to", lambda model, device: devices.append(device) or model)
    refresh(entry, ["speed"], device="cuda")
    assert devices == ["cuda"]
    assert Zoo.card("small", entry.parent)["speed"][0]["ms_per_frame"] > 0


def test_what_others_write_to_the_card_during_a_measurement_stays(entry, monkeypatch):
    elsewhere = {"hardware": "a GPU", "runtime": "eager float32", "particles": 9, "ms_per_frame": 1.0, "best_batch": 1}
    elsewhere |= {"best_ms_per_frame": 1.0, "memory_mb": 2.0, "best_memory_mb": None}

    def measure(model):
        add_facts(entry, model.card["sha256"], {"speed": [elsewhere]})
        refresh(entry, failures="Splashes become\n dust.")
        return elsewhere | {"hardware": "a CPU"}

    monkeypatch.setattr("nmpm.zoo.measures.speed.measure_speed", measure)
    refresh(entry, ["speed"])
    card = Zoo.card("small", entry.parent)
    assert [time["hardware"] for time in card["speed"]] == ["a GPU", "a CPU"]
    assert "- Seen in its pictures: Splashes become dust.\n" in (entry / "README.md").read_text()
    refresh(entry, failures="")
    assert "failures" not in Zoo.card("small", entry.parent)


def test_facts_that_are_written_at_the_same_time_all_stay(entry):
    weights = Zoo.card("small", entry.parent)["sha256"]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda number: add_facts(entry, weights, {f"fact{number}": number}), range(4)))
    card = Zoo.card("small", entry.parent)
    assert [card.get(f"fact{number}") for number in range(4)] == list(range(4))
    assert not list(entry.parent.glob("**/.*"))


def test_a_measure_of_weights_that_are_replaced_meanwhile_is_not_written(entry, small, write_entry, monkeypatch):
    def measure(model, folder, data):
        small.input_std.fill_(3.0)
        write_entry(entry, small, **COMPLETE)
        return {"floor": {"nudge": 1e-6, "mse": 0.25}}

    monkeypatch.setattr(module, "MEASURES", {"floor": measure})
    with pytest.raises(ZooError, match="replaced while floor was measured"):
        refresh(entry, ["floor"])
    assert "floor" not in Zoo.load("small", entry.parent).card  # it can be loaded


@pytest.mark.parametrize(
    ("change", "errors"),
    [({"training": None}, ""), ({"speed": ["x"]}, ""), ({}, "frame,model,still,free_fall\n1,0.1,0.2,0.3\n2,0.")],
    ids=str,
)
def test_an_incomplete_card_gets_one_line_and_nothing_is_rewritten(entry, change, errors, capsys):
    path = entry / "card.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | change))
    if errors:
        (entry / "errors.csv").write_text(errors)
    before = {file: file.read_bytes() for file in entry.rglob("*")}
    assert main(["zoo", "refresh", "small", "--root", str(entry.parent)]) == 1
    said = capsys.readouterr().err
    assert "The card of small or a table beside it is not complete" in said
    assert said.count("\n") == 1
    assert {file: file.read_bytes() for file in entry.rglob("*")} == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["small", "--measure", "sped"], "--measure sped: what can be measured is speed, quality, ensemble, twin"),
        (["--failures", "Dust."], "give the model's NAME too"),
        (["small", "--failures", "Late \x96 dust"], "'Late \\x96 dust' has a control character"),
    ],
)
def test_what_cannot_be_refreshed_is_named(entry, words, message, capsys):
    before = (entry / "card.yaml").read_bytes()
    assert main(["zoo", "refresh", *words, "--root", str(entry.parent)]) == 1
    assert message in capsys.readouterr().err
    assert (entry / "card.yaml").read_bytes() == before


def test_the_table_of_a_zoo_names_every_model_whose_card_can_be_read(entry, small, write_entry):
    write_entry(entry.parent / "odd", small, **COMPLETE | {"test": {"mse": "x"}, "speed": [{}]})
    (entry.parent / "broken").mkdir()
    (entry.parent / "broken" / "card.yaml").write_text("{")
    (entry / "errors.csv").write_text("frame,model,still,free_fall\n1,0.1,0.2,0.3\n2,0.2,0.3,0.4\n")
    assert main(["zoo", "refresh", "small", "--root", str(entry.parent)]) == 0
    text = (entry.parent / "README.md").read_text()
    assert "| [small](small/README.md) | 10 | 100 (50 – 150) |  | 1000 | 2.0 h |" in text
    assert "odd" not in text
    assert "broken" not in text
    assert "![errors over frames and over training](chart.png)" in (entry / "README.md").read_text()


@pytest.mark.parametrize("name", Zoo.list(SHIPPED))
def test_shipped_cards_are_short_and_their_pages_are_made_of_them(name):
    card = Zoo.card(name, SHIPPED)
    assert stated_milliseconds(card)["AMD EPYC, 1 thread"] > 0
    assert "twin" in card or name == "waterdrop" or name.endswith("/ensemble")
    assert len((SHIPPED / name / "card.yaml").read_text().splitlines()) <= (170 if "ensemble" in card else 120)
    page = entry_page(card, [path.name for path in (SHIPPED / name).iterdir()])
    assert (SHIPPED / name / "README.md").read_text() == page


def test_the_page_of_the_shipped_zoo_is_made_of_its_cards():
    page = (SHIPPED / "README.md").read_text()
    assert page == index_page(SHIPPED, Zoo.list(SHIPPED))
    assert "| [goop](goop/README.md) | 1,713 particles, MPM | 0.69 | 0.33 – 0.14 | 2.1 – 4.9 |" in page
    first = (SHIPPED.parent / "README.md").read_text()
    assert "| [dambreak2d](zoo/dambreak2d/README.md) | 5,000 particles, SPH | 52 | 1.4 – 0.90 | 37 – 57 |" in first
    assert replace_table(first, {name: Zoo.card(name, SHIPPED) for name in Zoo.list(SHIPPED)}, "zoo/") == first
    assert len([word for line in page.splitlines() if not line.startswith("|") for word in line.split()]) < 400


@pytest.mark.parametrize("name", [name for name in Zoo.list(SHIPPED) if "trade" in Zoo.card(name, SHIPPED)])
def test_speed_ups_of_cards_are_those_of_the_stored_trade_at_equal_error(name):
    card = Zoo.card(name, SHIPPED)
    with (SHIPPED.parent / "benchmarks" / "trade" / preset_of(card) / "trade.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["error"] == "mse" and row["stable"] == "True"]
    stable = [row for row in rows if row["kind"] == "simulator"]
    settings = [Setting(row["name"], float(row["ms_per_frame"]), float(row["value"])) for row in stable]
    forms = [row for row in rows if row["model"] == name and row["constraints"] == "held" and row["batch"] == "1"]
    assert {row["clock"] for row in [*stable, *forms]} == {"CPU time"}
    assert {row["weights"] for row in forms} == {weights_digest(Zoo.load(name, SHIPPED).emulator.state_dict())[:12]}
    times = {f"{row['runtime']} {row['precision']}": float(row["ms_per_frame"]) for row in forms}
    assert {time["runtime"]: time["ms_per_frame"] for time in card["trade"]["times"]} == times
    fastest = min(forms, key=lambda row: float(row["ms_per_frame"]))
    setting = at_equal_error(settings, float(fastest["value"]))
    assert f"simulator, {card['trade']['simulator']}" == setting.name
    assert card["trade"]["speed_up"] == pytest.approx(setting.milliseconds / min(times.values()), rel=2e-3)


@pytest.mark.parametrize(
    ("card", "state"),
    [
        ({"test": {"mse": 0.1, "still/mse": 0.4, "free_fall/mse": 0.5}}, "active"),
        ({"test": {"mse": 0.1, "still/mse": 0.5, "free_fall/mse": 0.39}}, "preview"),
        ({"test": {"mse": float("nan"), "still/mse": 0.5}}, "preview"),
        ({}, "preview"),
    ],
)
def test_the_lifecycle_follows_from_the_figures(card, state):
    assert lifecycle(card) == state


def test_trust_is_calibrated_on_the_validation_scenes(goop):
    card = Zoo.card("goop", goop.parent)
    add_facts(
        goop, card["sha256"], {"simulation": card["simulation"] | {"counts": {"train": 0, "valid": 2, "test": 2}}}
    )
    assert main(["zoo", "refresh", "goop", "--measure", "trust", "--root", str(goop.parent)]) == 0
    model = load_model(goop)
    assert model.trust.scenes == 2
    assert model.trust.to_card() == model.card["trust"]
    assert "(2 validation scenes; `nmpm rollout" in (goop / "README.md").read_text()
