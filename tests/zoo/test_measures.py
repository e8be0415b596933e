"""What `nmpm zoo refresh --measure` puts on cards."""

import shutil
from pathlib import Path

import pytest
import yaml

from nmpm.cli import main
from nmpm.errors import UnstableError, ZooError
from nmpm.evaluation.stress import QUICK, Line
from nmpm.evaluation.stress.settling import settling
from nmpm.sim import load_preset
from nmpm.sim.predictability import nudge
from nmpm.zoo import Zoo, index
from nmpm.zoo.cards import readme
from nmpm.zoo.index import refresh
from nmpm.zoo.measures import simulator
from nmpm.zoo.measures.simulator import NUDGE, measure_floor

SHIPPED = Path(__file__).parents[2] / "zoo"


@pytest.fixture
def goop(tmp_path) -> Path:
    """The shipped model with two short test scenes."""
    folder = tmp_path / "zoo" / "goop"
    shutil.copytree(SHIPPED / "goop", folder)
    preset = load_preset("goop").with_frames(24)
    simulation = {"preset": preset.to_dict(), "counts": {"train": 0, "valid": 0, "test": 2}, "seed": 0}
    card = yaml.safe_load((folder / "card.yaml").read_text()) | {
        "simulation": simulation | {"revision": preset.revision}
    }
    (folder / "card.yaml").write_text(yaml.safe_dump(card))
    return folder


def test_quality_floor_and_pictures_are_on_the_card(goop, capsys):
    former = (goop / "rollout.png").read_bytes()
    words = ["zoo", "refresh", "goop", "--measure", "quality", "floor", "--root", str(goop.parent)]
    assert main(words) == 0
    card = yaml.safe_load((goop / "card.yaml").read_text())
    quality, floor = card["quality"], card["floor"]
    for name in ("emd", "kinetic", "height", "crowding"):
        low, high = quality[name]["interval"]
        assert 0 <= low <= quality[name]["mean"] <= high
    assert 0 < quality["emd"]["mean"] < 0.01  # of a domain of length 1, in the first frames
    assert quality["worst"]["scene"] in (0, 1)
    assert 0 < floor["mse"] < 1e-2 * quality["worst"]["mse"]
    assert floor["nudge"] == NUDGE
    pictures = [(goop / name).read_bytes() for name in ("rollout.png", "worst.png")]
    assert all(picture[:4] == b"\x89PNG" for picture in pictures)
    assert former != pictures[0] != pictures[1]  # of the first scene, with a title in the other
    text = (goop / "README.md").read_text()
    assert "![the test scene with the largest error](worst.png)" in text
    assert "Predictability: the simulator beside itself" in text
    assert f"that of scene {quality['worst']['scene']}" in text


def test_the_floor_repeats(goop):
    model = Zoo.load("goop", goop.parent)
    assert measure_floor(model) == measure_floor(model)


def nudge_all_but(stable: set[int]):
    """`nudge`, unstable in all scenes but these."""
    scenes = iter(range(2))

    def nudge_or_fail(preset, state, size, seed):
        if next(scenes) not in stable:
            raise UnstableError("The simulation has blown up.")
        return nudge(preset, state, size, seed)

    return nudge_or_fail


def test_scenes_that_the_nudge_makes_unstable_are_named(goop, monkeypatch):
    model = Zoo.load("goop", goop.parent)
    both = measure_floor(model).errors["mse"]
    monkeypatch.setattr(simulator, "nudge", nudge_all_but({0}))
    first = measure_floor(model)
    monkeypatch.setattr(simulator, "nudge", nudge_all_but({1}))
    assert main(["zoo", "refresh", "goop", "--measure", "floor", "--root", str(goop.parent)]) == 0
    second = yaml.safe_load((goop / "card.yaml").read_text())["floor"]
    assert (first.unstable, second["unstable"]) == ((1,), [0])
    assert (first.errors["mse"] + second["mse"]) / 2 == pytest.approx(both)
    assert "Left out as the nudge makes them unstable: test scenes [0]." in (goop / "README.md").read_text()
    monkeypatch.setattr(simulator, "nudge", nudge_all_but(set()))
    with pytest.raises(UnstableError, match="all test scenes of goop unstable"):
        measure_floor(model)


def test_a_twin_that_is_unstable_names_its_scenes(goop, monkeypatch):
    class Unstable:
        substeps = 3

        def simulate_from(self, state, frames):
            raise UnstableError("The simulation has blown up.")

    monkeypatch.setattr(simulator, "twin_of", lambda preset: Unstable())
    with pytest.raises(UnstableError, match=r"With 3 substeps test scenes \[0, 1\] are unstable: goop has no twin"):
        simulator.measure_twin(Zoo.load("goop", goop.parent))


def test_stress_tests_held_and_free_are_counted_and_settling_is_simulated_once(goop, monkeypatch):
    settled = []

    def long(subject, size):
        assert size is QUICK
        held = subject.emulator.constraints.energy
        yield Line("long", "energy", held, {}, "")
        yield Line("long", "speed", None, {}, "")

    def settle(subject, size):
        settled.append(subject.emulator.constraints.energy)
        yield Line("settling", "with constraints", True, {}, "")
        yield Line("settling", "without constraints", False, {}, "")

    monkeypatch.setattr("nmpm.zoo.measures.stress.GROUPS", {"long": long, "settling": settle})
    refresh(goop, ["stress"])
    card = yaml.safe_load((goop / "card.yaml").read_text())
    assert settled == [True]
    assert card["stress"] == {"size": "quick", "passed": 2, "failed": ["settling: without constraints"]}
    free = ["long: energy", "settling: without constraints"]
    assert card["stress_free"] == {"size": "quick", "passed": 0, "failed": free}


def test_the_speed_is_measured_on_the_device_that_is_given(goop, monkeypatch, capsys):
    places = []
    monkeypatch.setattr("nmpm.zoo.pretrained.Pretrained.to", lambda model, device: places.append(device) or model)
    refresh(goop, ["speed"], device="cuda")
    assert places == ["cuda"]
    places.clear()
    command = ["zoo", "refresh", "goop", "--measure", "speed", "--root", str(goop.parent)]
    assert main([*command, "--device", "cuda:77"]) == 1
    assert "has no device 'cuda:77'" in capsys.readouterr().err
    assert not places


def test_invariants_are_tested_without_the_simulator(goop, monkeypatch):
    presets = []

    def long(subject, size):
        presets.append(subject.preset)
        yield Line("long", "energy", subject.emulator.constraints.energy, {}, "")

    monkeypatch.setattr("nmpm.zoo.measures.stress.GROUPS", {"long": long, "settling": settling})
    refresh(goop, ["invariants"])
    card = yaml.safe_load((goop / "card.yaml").read_text())
    assert presets == [None, None]
    assert card["stress"] == {"size": "quick, without the simulator", "passed": 1, "failed": []}
    assert card["stress_free"]["failed"] == ["long: energy"]
    assert "held: 1 of 1 lines passed, quick, without the simulator" in (goop / "README.md").read_text()


def test_a_measure_keeps_what_is_written_to_the_card_meanwhile(goop, monkeypatch):
    def measure(model, folder, data):
        refresh(folder, failures="Splashes become dust.")
        return {"floor": {"nudge": 1e-6, "mse": 0.25}}

    monkeypatch.setattr(index, "MEASURES", {"floor": measure})
    refresh(goop, ["floor"])
    card = yaml.safe_load((goop / "card.yaml").read_text())
    assert (card["failures"], card["floor"]) == ("Splashes become dust.", {"nudge": 1e-6, "mse": 0.25})


def test_a_measure_of_weights_that_are_replaced_meanwhile_is_not_written(goop, monkeypatch):
    def measure(model, folder, data):
        card = yaml.safe_load((folder / "card.yaml").read_text())
        index.write_card(folder, card | {"sha256": "0" * 64})
        return {"floor": {"nudge": 1e-6, "mse": 0.25}}

    monkeypatch.setattr(index, "MEASURES", {"floor": measure})
    with pytest.raises(ZooError, match="replaced while floor was measured"):
        refresh(goop, ["floor"])
    assert yaml.safe_load((goop / "card.yaml").read_text()).get("floor") != {"nudge": 1e-6, "mse": 0.25}


def test_what_cannot_be_measured_is_named(goop, capsys):
    with pytest.raises(ZooError, match=r"--measure sped: .* speed, quality, twin, floor, stress, invariants"):
        refresh(goop, ["sped"])
    assert main(["zoo", "refresh", "--measure", "quality", "--data", ".", "--root", str(goop.parent)]) == 1
    assert "give the model's NAME too" in capsys.readouterr().err


@pytest.mark.parametrize(("goal", "said"), [(0.6, "600 ×10⁻³, reached"), (0.25, "250 ×10⁻³, missed by a factor of 2")])
def test_a_card_says_whether_its_goal_is_reached(goop, goal, said):
    card = yaml.safe_load((goop / "card.yaml").read_text())
    assert f"Goal for `mse`: {said}" in readme(card | {"goal": goal, "test": card["test"] | {"mse": 0.5}})


def test_known_failures_are_on_the_card_until_they_are_taken_back(goop, capsys):
    words = ["zoo", "refresh", "goop", "--root", str(goop.parent), "--failures"]
    assert main([*words, "Splashes become\n dust."]) == 0
    assert main(words[:-1]) == 0  # a refresh keeps them
    assert "\nKnown failures: Splashes become dust.\n" in (goop / "README.md").read_text()
    assert main([*words, ""]) == 0
    assert "failures" not in yaml.safe_load((goop / "card.yaml").read_text())
    assert "Known failures" not in (goop / "README.md").read_text()
    assert main(["zoo", "refresh", "--root", str(goop.parent), "--failures", "Dust."]) == 1
    assert "give the model's NAME too" in capsys.readouterr().err


def test_a_refresh_with_failures_writes_the_entry_once(goop, monkeypatch):
    written = []
    monkeypatch.setattr("nmpm.zoo.index.save_chart", lambda folder, _figure: written.append(folder))
    refresh(goop, failures="Splashes become dust.")
    assert written == [goop]
