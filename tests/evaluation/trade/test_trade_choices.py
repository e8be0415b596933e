"""Sweeps and the choices that they make: what these predict, and which are left out or refused."""

import dataclasses
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from nmpm.emulator.digests import weights_digest
from nmpm.errors import ConfigError, NmpmError
from nmpm.evaluation.trade import (
    Kind,
    Sweep,
    find_factory,
    find_wider_scenes,
    make_choices,
    read_sweep,
    shipped_sweep_text,
)
from nmpm.evaluation.trade.choices import CPU, follow_nearest
from nmpm.evaluation.trade.sweep import ModelSettings
from nmpm.sim import load_preset
from tests.evaluation.trade.made_up import tiny_emulator, tiny_sweep

PATH = "tests.evaluation.trade.made_up:Shifted"


def named(choices, name):
    return next(choice for choice in choices if choice.name == name)


def test_shipped_sweeps_are_read_and_that_of_trade_states_the_defaults():
    assert read_sweep(shipped_sweep_text("trade"), "trade.yaml") == Sweep() == read_sweep("", "empty.yaml")
    compared = read_sweep(shipped_sweep_text("compare"), "compare.yaml")
    assert (compared.scenes, compared.models.batch, compared.measures.horizons) == (6, (1,), (8, 32, 100))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scene: 3", r"mine.yaml: unknown scene; keys: measures, models"),
        ("models: {batch: 8}", r"mine.yaml, models: batch = 8 should be a list, each a whole number"),
        ("models: {batch: [64]}", r"models.batch: 64 scenes at once of 20"),
        ("timing: {rounds: 0}", r"timing.rounds: 0 must be a positive number"),
        ("{", r"mine.yaml cannot be read"),
    ],
)
def test_mistakes_are_named(text, message):
    with pytest.raises(NmpmError, match=message):
        read_sweep(text, "mine.yaml")


def test_every_choice_predicts_all_frames_of_every_scene_and_the_shipped_simulator_repeats_them(scenes, choices):
    for choice in choices:
        predicted = choice.prepare(scenes, [1])(scenes.frames(1))
        assert predicted.shape == scenes.window([1]).target.shape, choice.name
    for index in range(2):
        assert torch.equal(choices[0].prepare(scenes, [index])(scenes.frames(index)), scenes.window([index]).target)


def test_several_scenes_at_once_predict_what_each_does_alone(scenes, choices):
    both = named(choices, "carried, batch 2").prepare(scenes, [0, 1])(4)
    for index in range(2):
        alone = named(choices, "carried").prepare(scenes, [index])(4)
        torch.testing.assert_close(both[index : index + 1, :, : alone.shape[2]], alone)


def test_recorded_particles_move_like_the_nearest_of_fewer_larger_ones():
    first = torch.tensor([[0.1, 0.1], [0.2, 0.1], [0.8, 0.1]])
    larger = np.array([[0.15, 0.1], [0.8, 0.12]])
    moves = torch.tensor([[0.0, 0.3], [0.05, 0.0]])  # of the two larger particles, per frame
    simulated = torch.from_numpy(larger).float() + torch.arange(3).view(3, 1, 1) * moves
    paths = follow_nearest(first, larger)(simulated)
    torch.testing.assert_close(paths, first + torch.arange(3).view(3, 1, 1) * moves[[0, 0, 1]])


def test_repeated_and_refused_settings_are_left_out_and_recorded_scenes_have_no_simulator(scenes, choices):
    names = [choice.name for choice in choices]
    assert len(names) == len(set(names))
    assert "carried, free" not in names  # it has no constraints
    least = dataclasses.replace(scenes.preset, substeps=scenes.preset.coarsened(1)._wave_substeps)
    strict = make_choices(tiny_sweep(), dataclasses.replace(scenes, preset=least), {})
    assert strict[0].name == f"simulator, {least.substeps} substeps"
    assert f"twin: {2 * least.substeps} of {least.substeps} substeps" in [choice.name for choice in strict]
    compared = make_choices(read_sweep(shipped_sweep_text("compare"), "compare.yaml"), scenes, {})
    twin = next(choice for choice in compared if choice.name.startswith("twin"))
    same = next(choice for choice in compared if choice.kind is Kind.SIMULATOR and choice.identity == twin.identity)
    assert same.name == "simulator, 3 substeps"  # the twin is a setting like others
    recorded = dataclasses.replace(scenes, preset=None, seeds=())
    kinds = {choice.kind for choice in make_choices(tiny_sweep(), recorded, {"one": tiny_emulator(scenes.scene)})}
    assert kinds == {Kind.MODEL, Kind.TRIVIAL}


def test_a_model_of_other_scenes_gets_cells_of_the_same_size_and_is_named_so(scenes):
    (left, right), floor = scenes.scene.domain
    half = (left, (left + right) / 2)
    narrow = tiny_emulator(
        dataclasses.replace(scenes.scene, domain=(half, floor), bounds=(half, scenes.scene.bounds[1]))
    )
    models = [c for c in make_choices(tiny_sweep(), scenes, {"one": narrow}) if c.kind is Kind.MODEL]
    assert {choice.settings["model"] for choice in models} == {"one (of other scenes)"}
    assert {choice.settings["weights"] for choice in models} == {weights_digest(narrow.state_dict())[:12]}
    assert "domain" in models[0].settings["scenes_differ_in"]
    assert (narrow.grid.shape, models[0].emulator.grid.shape) == ((4, 8), (8, 8))


def test_a_model_of_another_gravity_takes_the_scenes_at_a_stride_and_says_so_or_is_refused(scenes):
    gravity = tuple(4 * g for g in scenes.scene.gravity)
    other = tiny_emulator(dataclasses.replace(scenes.scene, gravity=gravity))
    model = next(c for c in make_choices(tiny_sweep(), scenes, {"other": other}) if c.kind is Kind.MODEL)
    assert model.settings["scenes_differ_in"] == "gravity; taken as 1 frame for 2 of the data, gravity × 1"
    predicted, _ = model.predict(scenes, 0)
    assert predicted.shape == scenes.window([0]).target.shape
    assert model.computed_frames(3) == 4  # a bundle of two frames, two of the scenes each
    assert dict(model.identity)["reading"]["every"] == 2
    far = tiny_emulator(dataclasses.replace(scenes.scene, gravity=(gravity[1], gravity[1])))  # along no axis
    with pytest.raises(ConfigError, match=r"model far cannot predict the scenes of .* turn the data"):
        make_choices(tiny_sweep(), scenes, {"far": far}, strict=True)


def test_runtimes_are_choices_of_their_own(scenes):
    if find_spec("openvino") is None:  # importing it would report to its makers
        pytest.skip("openvino is not installed")
    settings = dataclasses.replace(tiny_sweep().models, runtime=("eager", "openvino"), batch=(1,))
    sweep, models = dataclasses.replace(tiny_sweep(), models=settings), {"carried": tiny_emulator(scenes.scene)}
    plain, quick = (choice for choice in make_choices(sweep, scenes, models) if choice.kind is Kind.MODEL)
    assert (plain.name, quick.name) == ("carried", "carried, openvino")
    assert quick.identity == dict(plain.identity) | {"runtime": "openvino"}
    wrong = dataclasses.replace(sweep, models=dataclasses.replace(settings, runtime=("fast",)))
    with pytest.raises(ConfigError, match="There is no runtime 'fast'"):
        make_choices(wrong, scenes, models)


@pytest.mark.parametrize(("emulated", "installed"), [(True, True), (False, True), (True, False)])
def test_emulated_precisions_are_left_out_and_installed_runtimes_take_part(scenes, monkeypatch, emulated, installed):
    monkeypatch.setattr("nmpm.evaluation.trade.sweep.computes_bfloat16", lambda _: not emulated)
    monkeypatch.setattr("nmpm.evaluation.trade.sweep.find_spec", lambda name: name if installed else None)
    settings = ModelSettings(constraints=("held",), batch=(1,))
    sweep = dataclasses.replace(tiny_sweep(), models=settings)
    choices = make_choices(sweep, scenes, {"carried": tiny_emulator(scenes.scene)})
    runtimes = [choice.settings["runtime"] for choice in choices if choice.kind is Kind.MODEL]
    assert runtimes == ["eager"] + ["openvino"] * installed
    assert settings.precisions(CPU) == ("float32", "bfloat16")[: 1 if emulated else 2]
    lines = " ".join(settings.left_out(CPU))
    assert ("bfloat16 is left out" in lines, "OpenVINO" in lines) == (emulated, not installed)
    alone = dataclasses.replace(settings, precision=("bfloat16",))
    assert alone.precisions(CPU) == ("bfloat16",)
    assert settings.runtimes(torch.device("cuda")) == ("eager",)


def test_a_predictor_of_another_package_is_a_choice(scenes):
    factories = [find_factory(PATH), find_factory(f"{PATH}:0.5")]
    still, moving = (c for c in make_choices(tiny_sweep(), scenes, {}, predictors=factories)[-4:-2])
    assert (still.kind, still.name, moving.name) == (Kind.OTHER, "shifted by 0", "shifted by 0.5")
    start = scenes.window([0]).initial.position
    assert torch.equal(moving.prepare(scenes, [0])(3)[:, 2], start + 1.5)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("nowhere:make", "No module named 'nowhere'"),
        (PATH + "s", "has no attribute 'Shifteds'"),
        ("nowhere", "module:factory"),
        ("builtins:repr", "no callable with a name"),
        (PATH, "Two choices are called 'shifted by 0'"),
    ],
)
def test_predictors_that_cannot_be_used_are_named(path, message, scenes):
    with pytest.raises(ConfigError, match=message):
        make_choices(tiny_sweep(), scenes, {}, predictors=[find_factory(PATH), find_factory(path)])


def test_wider_scenes_are_simulated_once_over_a_wider_domain(tmp_path, monkeypatch):
    tiny = dataclasses.replace(load_preset("goop").coarsened(4).with_frames(4), substeps=6)
    monkeypatch.setenv("NMPM_HOME", str(tmp_path))
    monkeypatch.setattr("nmpm.evaluation.trade.scenes.load_preset", {"goop": tiny}.get)
    wide = find_wider_scenes("goop", 1, 2)
    assert (wide.name, len(wide)) == ("goop-2-times-as-wide", 1)
    (left, right), _ = tiny.scene.domain
    (wide_left, wide_right), _ = wide.scene.domain
    assert wide_right - wide_left == pytest.approx(2 * (right - left))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.h5")}
    assert find_wider_scenes("goop", 1, 2).digests == wide.digests
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.h5")} == before
    with pytest.raises(ConfigError, match="cannot be widened: it is not an embedded dataset"):
        find_wider_scenes(str(tmp_path), 1, 2)
