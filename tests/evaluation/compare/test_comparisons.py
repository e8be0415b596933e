import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from nmpm.data.catalog import describe
from nmpm.emulator import rollout
from nmpm.errors import ConfigError
from nmpm.evaluation.bootstrap import interval
from nmpm.evaluation.compare import compare, count_steps, make_predictors, origin_lines, outcome_table, write_report
from nmpm.evaluation.compare.measure import shown_frames
from nmpm.evaluation.compare.table import failure_lines
from nmpm.evaluation.trade import Kind, Store, find_wider_scenes
from nmpm.evaluation.trade.timing import Timing
from nmpm.sim import load_preset
from tests.evaluation.trade.made_up import tiny_emulator, tiny_scenes

TIMING = Timing(rounds=1, frames=2)


@pytest.fixture(autouse=True)
def few_matches(monkeypatch):
    """Matching all particles would take most of the tests' time."""
    monkeypatch.setattr("nmpm.evaluation.compare.measure.MATCHED", 40)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return tiny_scenes(tmp_path_factory.mktemp("data") / "tiny")


@pytest.fixture(scope="module")
def narrow(scenes):
    """An emulator of a box half as wide, 4 × 8 cells; those of the scenes have the same size."""
    (left, right), floor = scenes.scene.domain
    half = (left, (left + right) / 2)
    return tiny_emulator(dataclasses.replace(scenes.scene, domain=(half, floor), bounds=(half, scenes.scene.bounds[1])))


def run(candidates, scenes, folder):
    done = []
    return compare(candidates, scenes, Store(folder), done.append, TIMING), done


def by_name(outcomes):
    return {outcome.name: outcome for outcome in outcomes}


def test_a_model_at_home_stays_and_another_gets_more_cells_of_the_same_size(scenes, narrow):
    home = tiny_emulator(scenes.scene)
    candidates = {one.choice.name: one for one in make_predictors(scenes, {"home": home, "narrow": narrow})}
    assert candidates["home"].choice.emulator is home
    assert candidates["home"].differing == ()
    adapted = candidates["narrow"].choice.emulator
    assert narrow.grid.shape == (4, 8)
    assert adapted.grid.shape == (8, 8)
    assert adapted.scene == scenes.scene
    assert candidates["narrow"].differing == ("bounds", "domain")


def test_a_model_of_other_time_steps_is_refused_by_name(scenes):
    other = tiny_emulator(dataclasses.replace(scenes.scene, dt=1.0))
    with pytest.raises(ConfigError, match=r"The model slow cannot predict the scenes of tiny\. .* dt = 1\.0"):
        make_predictors(scenes, {"slow": other})


def test_recorded_scenes_have_no_simulator(scenes):
    recorded = dataclasses.replace(scenes, preset=None, seeds=())
    assert {one.choice.kind for one in make_predictors(recorded, {})} == {Kind.TRIVIAL}


def test_errors_are_those_of_the_predictions(scenes, tmp_path):
    emulator = tiny_emulator(scenes.scene)
    candidates = make_predictors(scenes, {"carried": emulator})
    outcomes, done = run(candidates, scenes, tmp_path)
    assert len(done) == count_steps(candidates, scenes, TIMING)
    found = by_name(outcomes)
    still = found["nothing moves"]
    for index, recording in enumerate(scenes.recordings):
        expected = (recording.frames[2:] - recording.frames[1]).double().square().mean((1, 2)).numpy()
        np.testing.assert_allclose(still.curves[index], expected, rtol=1e-4)
        assert still.errors["mse"][index] == pytest.approx(expected.mean(), rel=1e-4)
        assert still.errors["mse@8"][index] == pytest.approx(expected[:8].mean(), rel=1e-4)
    assert still.mean("mse") == pytest.approx(still.errors["mse"].mean())
    assert still.interval("mse") == interval(still.errors["mse"].tolist())
    assert math.isfinite(still.milliseconds[1])
    window = scenes.window([1])
    predicted = rollout(emulator, window.initial, scenes.frames(1))
    expected = (predicted - window.target).double().square().mean((0, 2, 3)).numpy()
    np.testing.assert_allclose(found["carried"].curves[1], expected, rtol=1e-4)
    shown = found["nothing moves"].frames
    np.testing.assert_allclose(shown[0], scenes.recordings[0].frames[1].numpy(), rtol=1e-6)


def test_the_simulator_that_made_the_scenes_is_only_timed_and_its_twin_is_compared(scenes, tmp_path):
    outcomes, _ = run(make_predictors(scenes, {}), scenes, tmp_path)
    shipped = outcomes[0]
    assert shipped.candidate.reproduces
    assert shipped.mean("mse") == 0
    last = scenes.recordings[0].frames[2:][shown_frames(scenes)[-1]].numpy()
    np.testing.assert_allclose(shipped.frames[-1], last)
    (twin,) = (one for one in outcomes if one.kind is Kind.FLOOR)
    assert 0 < twin.mean("mse") < by_name(outcomes)["nothing moves"].mean("mse")


@pytest.mark.parametrize("name", ["dambreak2d", "wbcsph"])
def test_a_twin_stands_beside_simulators_that_are_unstable_with_half_of_the_substeps(scenes, name):
    preset = load_preset(name)
    shipped, twin = make_predictors(dataclasses.replace(scenes, preset=preset), {})[:2]
    assert shipped.reproduces
    assert twin.choice.kind is Kind.FLOOR
    assert twin.choice.settings["substeps"] not in {preset.substeps, preset.substeps // 2}


def test_one_more_model_measures_only_what_is_new(scenes, narrow, tmp_path, monkeypatch):
    first, _ = run(make_predictors(scenes, {"home": tiny_emulator(scenes.scene)}), scenes, tmp_path)
    torch.manual_seed(1)
    candidates = make_predictors(scenes, {"home": tiny_emulator(scenes.scene), "narrow": narrow})
    prepared = []
    for candidate in candidates:
        kind = type(candidate.choice)
        monkeypatch.setattr(kind, "prepare", _recording(kind.prepare, prepared))
    again, _ = run(candidates, scenes, tmp_path)
    # The reference is timed again for the ratio of the new model's time.
    assert set(prepared) <= {"narrow", candidates[0].choice.name}
    assert by_name(again)["home"].to_dict()["errors"] == by_name(first)["home"].to_dict()["errors"]


def _recording(prepare, names):
    def recorded(self, scenes, indices):
        if self.name not in names:
            names.append(self.name)
        return prepare.__wrapped__(self, scenes, indices)

    original = getattr(prepare, "__wrapped__", prepare)
    recorded.__wrapped__ = original
    return recorded


def test_a_prediction_that_is_not_finite_is_named_and_the_rest_is_reported(scenes, tmp_path):
    broken = tiny_emulator(scenes.scene)
    broken.input_mean.fill_(0)
    broken.output_scale.fill_(math.nan)
    outcomes, _ = run(make_predictors(scenes, {"broken": broken}), scenes, tmp_path / "store")
    failed = by_name(outcomes)["broken"]
    assert set(failed.failures) == {0, 1}
    assert math.isnan(failed.mean("mse"))
    (line,) = failure_lines(outcomes)
    assert line.startswith("broken: unstable in 2 scenes, first in scene 0: ")
    paths = write_report(tmp_path / "out", outcomes, scenes)
    assert [path.name for path in paths] == ["compare.json", "errors.png", "frames.png"]
    plain = json.loads(paths[0].read_text())
    assert {one["name"]: one["errors"].get("mse", {}).get("mean") for one in plain["predictors"]}["broken"] is None


def test_report_and_table_state_the_same_figures(scenes, narrow, tmp_path):
    outcomes, _ = run(make_predictors(scenes, {"narrow": narrow}), scenes, tmp_path / "store")
    paths = write_report(tmp_path / "out", outcomes, scenes)
    assert all(path.stat().st_size > 0 for path in paths)
    plain = json.loads(paths[0].read_text())
    assert plain["scenes"] == 2
    stated = {one["name"]: one for one in plain["predictors"]}
    still = by_name(outcomes)["nothing moves"]
    assert stated["nothing moves"]["errors"]["mse"]["mean"] == pytest.approx(still.mean("mse"), rel=1e-4)
    assert len(stated["nothing moves"]["curve"]) == scenes.frames(0)
    assert stated["narrow"]["scenes_differ_in"] == ["bounds", "domain"]
    assert len(stated["narrow"]["weights"]) == 64
    assert stated["nothing moves"]["weights"] is None
    assert origin_lines(outcomes) == ["narrow: trained on other scenes; what differs: bounds, domain"]
    table = outcome_table(outcomes, scenes)
    names = list(table.columns[0].cells)
    assert names == [outcome.name for outcome in outcomes]
    full = dict(zip(names, table.columns[-4].cells, strict=True))
    assert full[names[0]] == "made the scenes"
    assert full["nothing moves"].startswith(f"{1e3 * still.mean('mse'):.3g} (")


def test_wider_scenes_are_simulated_once_over_a_wider_domain(tmp_path, monkeypatch):
    tiny = dataclasses.replace(load_preset("goop").coarsened(4).with_frames(4), substeps=6)
    monkeypatch.setenv("NMPM_HOME", str(tmp_path))
    monkeypatch.setattr(
        "nmpm.evaluation.trade.datasets.load_preset", lambda name: {describe("goop").preset: tiny}[name]
    )
    wide = find_wider_scenes("goop", 1, 2)
    assert wide.name == "goop-2-times-as-wide"
    (left, right), _ = tiny.scene.domain
    (wide_left, wide_right), _ = wide.scene.domain
    assert wide_right - wide_left == pytest.approx(2 * (right - left))
    assert len(wide) == 1
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.h5")}
    assert find_wider_scenes("goop", 1, 2).digests == wide.digests
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.h5")} == before
    adapted = tiny_emulator(tiny.scene).over(wide.scene)
    assert adapted.grid.shape == (16, 8)


def test_only_embedded_datasets_are_widened(tmp_path):
    with pytest.raises(ConfigError, match="cannot be widened: it is not an embedded dataset"):
        find_wider_scenes(str(tmp_path), 1, 2)
