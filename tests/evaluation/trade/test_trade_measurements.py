"""Choices over a tiny simulated dataset: what they predict, and that stored measurements are taken up."""

import base64
import csv
import dataclasses
import itertools
import json
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from nmpm._support.digests import short_digest
from nmpm.data.generate import generate
from nmpm.data.loading.recording import Recording
from nmpm.errors import ConfigError
from nmpm.evaluation.baselines import free_fall
from nmpm.evaluation.gns import GraphRecipe, TrainedGraph
from nmpm.evaluation.trade import Choice, Kind, Scenes, Store, count_steps, make_choices, measure, read_scenes
from nmpm.evaluation.trade.accuracy import known_accuracy, measure_accuracy, thumbnail
from nmpm.evaluation.trade.errors import field_error, into_domain, measure_errors
from nmpm.evaluation.trade.simulators import SimulatorChoice, follow_nearest
from nmpm.evaluation.trade.table import COLUMNS, csv_text
from nmpm.evaluation.trade.timing import Timing, known_times, measure_times
from nmpm.evaluation.trade.trivial import TrivialChoice
from nmpm.scene import Scene
from nmpm.sim import load_preset
from nmpm.sim.sph.preset import SphPreset
from nmpm.sim.state import SimulatedTrajectory
from tests.evaluation.trade.made_up import tiny_emulator, tiny_scenes, tiny_sweep


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return tiny_scenes(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def choices(scenes):
    return make_choices(tiny_sweep(), scenes, {"carried": tiny_emulator(scenes.scene)})


def named(choices, name):
    return next(choice for choice in choices if choice.name == name)


def test_every_choice_predicts_all_frames_of_every_scene(scenes, choices):
    for choice in choices:
        for index in range(2):
            frames = scenes.frames(index)
            predicted = choice.prepare(scenes, [index])(frames)
            assert predicted.shape == scenes.window([index]).target.shape, choice.name


def test_several_scenes_at_once_predict_what_each_does_alone(scenes, choices):
    both = named(choices, "carried, batch 2").prepare(scenes, [0, 1])(4)
    for index in range(2):
        alone = named(choices, "carried").prepare(scenes, [index])(4)
        count = alone.shape[2]
        torch.testing.assert_close(both[index : index + 1, :, :count], alone)


def test_the_simulator_as_shipped_repeats_the_data_to_the_bit(scenes, choices):
    reference = choices[0]
    assert isinstance(reference, SimulatorChoice)
    for index in range(2):
        predicted = reference.prepare(scenes, [index])(scenes.frames(index))
        assert torch.equal(predicted, scenes.window([index]).target)


def test_a_nudge_moves_the_simulation_a_little(scenes, choices):
    nudged = next(choice for choice in choices if "nudged" in choice.name)
    distance = nudged.prepare(scenes, [0])(4) - scenes.window([0], 4).target
    assert 0 < float(distance.abs().max()) < 1e-3
    assert nudged.kind is Kind.FLOOR


def test_recorded_particles_move_like_the_nearest_of_fewer_larger_ones():
    first = torch.tensor([[0.1, 0.1], [0.2, 0.1], [0.8, 0.1]])
    larger = np.array([[0.15, 0.1], [0.8, 0.12]])
    moves = torch.tensor([[0.0, 0.3], [0.05, 0.0]])  # of the two larger particles, per frame
    simulated = torch.from_numpy(larger).float() + torch.arange(3).view(3, 1, 1) * moves
    paths = follow_nearest(first, larger)(simulated)
    torch.testing.assert_close(paths, first + torch.arange(3).view(3, 1, 1) * moves[[0, 0, 1]])


def test_measuring_again_measures_nothing_and_gives_the_same_points(scenes, choices, tmp_path, monkeypatch):
    sweep, store, steps = tiny_sweep(), Store(tmp_path), []
    first = measure(choices, scenes, sweep, store, steps.append)
    assert len(steps) == count_steps(choices, scenes, sweep)
    for choice in choices:
        monkeypatch.setattr(type(choice), "prepare", lambda *_: pytest.fail("measured again"))
    again = measure(choices, scenes, sweep, Store(tmp_path), lambda _: None)
    assert csv_text(again, scenes) == csv_text(first, scenes)


def test_an_interrupted_measurement_goes_on_to_the_same_errors(scenes, choices, tmp_path):
    sweep, choice = tiny_sweep(), named(choices, "carried")
    whole, cut = Store(tmp_path / "whole"), Store(tmp_path / "cut")
    list(measure_accuracy(choice, scenes, sweep.measures, whole))
    next(measure_accuracy(choice, scenes, sweep.measures, cut))  # killed after the first scene
    (path,) = (tmp_path / "cut" / "points").iterdir()
    assert len(json.loads(path.read_text())["known"]) == 1
    list(measure_accuracy(choice, scenes, sweep.measures, cut))
    assert path.read_bytes() == next((tmp_path / "whole" / "points").iterdir()).read_bytes()


def test_stored_predictions_give_other_errors_without_predicting(scenes, tmp_path, monkeypatch):
    choice, store = TrivialChoice("free fall"), Store(tmp_path, keep_predictions=True)
    measures = tiny_sweep().measures
    list(measure_accuracy(choice, scenes, measures, store))
    monkeypatch.setattr(TrivialChoice, "prepare", lambda *_: pytest.fail("predicted again"))
    list(measure_accuracy(choice, scenes, dataclasses.replace(measures, horizons=(2,)), store))
    assert len(list(tmp_path.glob("predictions/*/*.npz"))) == 2


@pytest.fixture(scope="module")
def drops(tmp_path_factory):
    """One test scene of a few drops of SPH water, of 16 frames, and the choice that simulates it coarser."""
    preset = load_preset("wbcsph").coarsened(4).with_frames(16)
    folder = tmp_path_factory.mktemp("drops")
    generate(preset, folder, {"train": 0, "valid": 0, "test": 1}, workers=1)
    return read_scenes("drops", folder, 1), SimulatorChoice("coarser", preset.coarsened(2), {})


def simulate_as(path, monkeypatch):
    """Let SPH presets simulate `path`, from the initial positions (M, D) and a number of frames."""

    def simulate_from(self, start, frames, progress=None):
        position = path(start.position, frames).astype(np.float32)
        return SimulatedTrajectory(position, np.full(position.shape[1], 5), {})

    monkeypatch.setattr(SphPreset, "simulate_from", simulate_from)


def rise_and_fall(start, frames):
    """The particle nearest to the floor rises like all others fall: the energy stays, unless it counts more often."""
    rise = 5e-4 * np.arange(frames + 1) ** 2
    path = np.repeat(start[None], frames + 1, axis=0)
    path[..., 1] -= rise[:, None] / (len(start) - 1)
    path[:, np.argmin(start[:, 1]), 1] = start[:, 1].min() + rise
    return path


def test_a_simulation_of_larger_particles_is_judged_by_their_own_energy(drops, tmp_path, monkeypatch):
    scenes, coarser = drops
    first = scenes.recordings[0].frames[0].clone()
    start = coarser.preset.draw(scenes.seeds[0]).position
    crowd = torch.from_numpy(start[np.argmin(start[:, 1])]).float()
    first[: len(first) // 2] = crowd  # half of the recorded particles follow the one that rises
    frames = first.expand_as(scenes.recordings[0].frames)
    crowded = dataclasses.replace(scenes, recordings=(dataclasses.replace(scenes.recordings[0], frames=frames),))
    simulate_as(rise_and_fall, monkeypatch)
    predicted = coarser.predict(crowded, 0, crowded.frames(0))
    followed = measure_errors(scenes.scene, crowded.window([0]), predicted.position, tiny_sweep().measures)["gain"]
    assert followed > 0.05 > abs(predicted.gain)
    (point,) = measure([coarser], crowded, tiny_sweep(), Store(tmp_path), lambda _: None)
    assert point.stable


def test_a_simulation_of_larger_particles_that_gains_energy_is_unstable(drops, tmp_path, monkeypatch):
    scenes, coarser = drops
    simulate_as(lambda start, frames: start + 0.002 * np.arange(frames + 1)[:, None, None] ** 2, monkeypatch)
    store = Store(tmp_path, keep_predictions=True)
    measures = tiny_sweep().measures
    for judged in (measures, dataclasses.replace(measures, horizons=(2,))):  # anew, then of the stored prediction
        list(measure_accuracy(coarser, scenes, judged, store))
        assert "of energy" in known_accuracy(coarser, scenes, judged, store)[0]["failed"]
        monkeypatch.setattr(SphPreset, "simulate_from", lambda *_: pytest.fail("simulated again"))


def test_stored_predictions_keep_the_energy_gain_of_other_particles(drops, tmp_path, monkeypatch):
    scenes, coarser = drops
    store, measures = Store(tmp_path, keep_predictions=True), tiny_sweep().measures
    list(measure_accuracy(coarser, scenes, measures, store))
    (first,) = known_accuracy(coarser, scenes, measures, store)
    other = dataclasses.replace(measures, horizons=(2,))
    with monkeypatch.context() as patch:
        patch.setattr(SphPreset, "simulate_from", lambda *_: pytest.fail("simulated again"))
        list(measure_accuracy(coarser, scenes, other, store))
    (again,) = known_accuracy(coarser, scenes, other, store)
    assert again["gain"] == first["gain"]
    assert "failed" not in again


def test_a_stored_prediction_without_energy_gain_is_not_used(drops, tmp_path):
    scenes, coarser = drops
    store = Store(tmp_path, keep_predictions=True)
    list(measure_accuracy(coarser, scenes, tiny_sweep().measures, store))
    (path,) = tmp_path.glob("predictions/*/*.npz")
    np.savez_compressed(path, position=np.load(path)["position"])  # as a former version wrote it
    assert store.read_prediction(dict(coarser.identity), scenes.digests[0], scenes.frames(0)) is None


class Made(Choice):
    """Predicts what a function makes of the recorded frames."""

    kind, settings = Kind.MODEL, {}

    def __init__(self, name, make):
        self.name, self.make = name, make

    @property
    def identity(self):
        return {"made": self.name}

    def prepare(self, scenes, indices):
        return lambda frames: self.make(scenes.window(indices, frames).target)


def fail(_):
    raise ConfigError("the simulation has blown up in frame 3")


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (fail, "the simulation has blown up in frame 3"),
        (lambda target: target / (torch.arange(target.shape[1]) != 2).view(1, -1, 1, 1), "from predicted frame 3 on"),
        (lambda target: target + 0.1 * torch.arange(target.shape[1]).view(1, -1, 1, 1), "of energy"),
    ],
    ids=["raises", "not finite", "gains energy"],
)
def test_what_fails_is_named_and_does_not_compete(scenes, tmp_path, make, reason):
    (point,) = measure([Made("bad", make)], scenes, tiny_sweep(), Store(tmp_path), lambda _: None)
    assert not point.competes
    assert set(point.failures) == {0, 1}
    assert all(reason in text for text in point.failures.values())


def test_errors_of_a_shift_are_in_closed_form(scenes, tmp_path):
    shifted = Made("shifted", lambda target: target + torch.tensor([0.01, 0.0]))
    (point,) = measure([shifted], scenes, tiny_sweep(), Store(tmp_path), lambda _: None)
    np.testing.assert_allclose(point.errors["mse"], 0.01**2 / 2, rtol=1e-3)  # the mean over two axes
    np.testing.assert_allclose(point.errors["emd"], 0.01, rtol=1e-3)
    np.testing.assert_allclose(point.errors["height"], 0, atol=1e-6)


def test_free_fall_conserves_energy_and_repeats_free_fall(scenes):
    window = scenes.window([0])
    falling = free_fall(scenes.scene, window.initial, 6)
    found = measure_errors(
        scenes.scene, dataclasses.replace(window, frames=torch.cat([window.frames[:, :2], falling], 1)), falling,
        tiny_sweep().measures,
    )  # fmt: skip
    assert found["mse"] == found["field"] == found["kinetic"] == found["height"] == found["crowding"] == 0
    if not bool((falling[..., 1] <= scenes.scene.bounds[1][0]).any()):
        assert abs(found["gain"]) < 1e-3


def test_resting_frames_are_not_timed(scenes):
    frames = scenes.recordings[0].frames
    stopped = torch.cat([frames[:6], frames[5:6].expand(20, -1, -1)])
    rest = dataclasses.replace(
        scenes, recordings=(dataclasses.replace(scenes.recordings[0], frames=stopped), *scenes.recordings[1:])
    )
    assert rest.moving_frames(0) == 4  # frames 2 to 5, as predictions start at frame 2
    assert rest.frames(0) == 24


def test_repeated_choices_are_left_out(scenes):
    names = [choice.name for choice in make_choices(tiny_sweep(), scenes, {"carried": tiny_emulator(scenes.scene)})]
    assert len(names) == len(set(names))
    assert "carried, free" not in names  # it has no constraints


def test_runtimes_are_choices_of_their_own(scenes):
    if find_spec("openvino") is None:  # importing it would report to its makers
        pytest.skip("openvino is not installed")
    settings = dataclasses.replace(tiny_sweep().models, runtime=("eager", "openvino"), batch=(1,))
    sweep, models = dataclasses.replace(tiny_sweep(), models=settings), {"carried": tiny_emulator(scenes.scene)}
    plain, quick = (choice for choice in make_choices(sweep, scenes, models) if choice.kind is Kind.MODEL)
    assert (plain.name, quick.name) == ("carried", "carried, openvino")
    assert (plain.settings["runtime"], quick.settings["runtime"]) == ("eager", "openvino")
    assert quick.identity == dict(plain.identity) | {"runtime": "openvino"}
    wrong = dataclasses.replace(sweep, models=dataclasses.replace(settings, runtime=("fast",)))
    with pytest.raises(ConfigError, match="No runtime is called 'fast'"):
        make_choices(wrong, scenes, models)


def tiny_graph(scene, curve=((1.0, 0.5), (2.0, 0.1))):
    torch.manual_seed(0)
    return TrainedGraph(GraphRecipe(scene, width=4, steps=1).build().eval(), 2.0, 10, curve)


def test_graph_networks_are_choices_that_say_whether_they_have_converged(scenes, tmp_path):
    graph = tiny_graph(scenes.scene)
    with torch.no_grad():
        graph.simulator.network.decode[-1].weight.zero_()
        graph.simulator.network.decode[-1].bias.zero_()  # no acceleration: all flies on
    found = make_choices(tiny_sweep(), scenes, {}, graphs={"here": graph, "there": graph})
    names = [choice.name for choice in found if choice.kind is Kind.GRAPH]
    assert names == [f"GNS, 2 min of training, not converged ({name})" for name in ("here", "there")]
    choice = next(choice for choice in found if choice.kind is Kind.GRAPH)
    state = scenes.window([0]).initial
    straight = state.position.unsqueeze(1) + torch.arange(1, 5).view(1, -1, 1, 1) * state.velocity.unsqueeze(1)
    torch.testing.assert_close(choice.prepare(scenes, [0])(4), straight, atol=1e-5, rtol=0)
    (point,) = measure([choice], scenes, tiny_sweep(), Store(tmp_path), lambda _: None)
    assert (point.kind, point.settings["training_minutes"]) == (Kind.GRAPH, 2.0)


def test_a_graph_network_of_other_scenes_is_rejected(scenes):
    other = tiny_graph(dataclasses.replace(scenes.scene, dt=2 * scenes.scene.dt))
    with pytest.raises(ConfigError, match=r"graph simulator other was trained for other scenes .*: dt differ"):
        make_choices(tiny_sweep(), scenes, {}, graphs={"other": other})


def test_a_model_that_cannot_take_the_scenes_is_rejected(scenes):
    other = dataclasses.replace(scenes.scene, dt=2 * scenes.scene.dt)
    with pytest.raises(ConfigError, match=r"model other cannot predict the scenes of .* made for dt"):
        make_choices(tiny_sweep(), scenes, {"other": tiny_emulator(other)})


def test_a_model_of_other_scenes_is_rebuilt_for_these_and_named_so(scenes):
    finer = dataclasses.replace(scenes.scene, particle_volume=scenes.scene.particle_volume / 2)
    one = tiny_emulator(finer)
    found = [c for c in make_choices(tiny_sweep(), scenes, {"one": one}) if c.kind is Kind.MODEL]
    assert {choice.settings["model"] for choice in found} == {"one (of other scenes)"}
    assert {choice.settings["weights"] for choice in found} == {short_digest(one.state_dict())}
    assert all(choice.emulator.scene == scenes.scene for choice in found)


def test_settings_that_a_simulator_refuses_are_left_out(scenes):
    least = dataclasses.replace(scenes.preset, substeps=scenes.preset.coarsened(1)._wave_substeps)
    strict = dataclasses.replace(scenes, preset=least)
    names = [choice.name for choice in make_choices(tiny_sweep(), strict, {})]
    assert not any(name.startswith("twin") for name in names)
    assert f"simulator, {least.substeps} substeps" in names


def test_without_a_simulator_models_and_trivial_predictors_remain(scenes):
    recorded = dataclasses.replace(scenes, preset=None, seeds=())
    kinds = {choice.kind for choice in make_choices(tiny_sweep(), recorded, {"one": tiny_emulator(scenes.scene)})}
    assert kinds == {Kind.MODEL, Kind.TRIVIAL}


def test_the_table_is_tidy(scenes, choices, tmp_path):
    points = measure(choices, scenes, tiny_sweep(), Store(tmp_path), lambda _: None)
    header, *rows = csv_text(points, scenes).splitlines()
    assert header.split(",") == list(COLUMNS)
    table = list(csv.DictReader([header, *rows]))
    assert len({(row["name"], row["error"]) for row in table}) == len(table) == 7 * len(points)
    first = next(row for row in table if row["name"] == "carried, batch 2" and row["error"] == "mse")
    assert (first["kind"], first["batch"], first["constraints"]) == ("model", "2", "held")
    assert first["weights"] == short_digest(tiny_emulator(scenes.scene).state_dict())
    assert {row["weights"] for row in table if row["kind"] != "model"} == {""}
    assert float(first["low"]) <= float(first["value"]) <= float(first["high"])
    assert np.isclose(float(first["frames_per_second"]) * float(first["ms_per_frame"]), 1000, rtol=1e-3)


def test_the_field_error_asks_where_material_is_and_not_which_particle(scenes):
    target = scenes.window([0]).target[0].double()
    material = scenes.recordings[0].material
    shuffled = target[:, torch.randperm(target.shape[1], generator=torch.Generator().manual_seed(0))]
    assert field_error(scenes.scene, shuffled, target, material) < 1e-12
    left, right = (torch.full_like(target, place) for place in (0.2, 0.8))
    assert field_error(scenes.scene, left, right, material) == 1
    half = torch.cat([left[:, ::2], right[:, 1::2]], dim=1)[:, : left.shape[1]]
    share = 1 - left[:, ::2].shape[1] / left.shape[1]
    np.testing.assert_allclose(field_error(scenes.scene, half, left, material), share, rtol=1e-6)


def flow(start, steps):
    """Scenes of 100 particles in a square of period 1 along x, that start at x = `start` and move by `steps` (T,)."""
    scene = Scene(
        bounds=((0.0, 1.0),) * 2, domain=((0.0, 1.0),) * 2, dt=0.01, materials=("water",), particle_volume=1e-3,
        boundary=("periodic", "wall"), gravity=(0.0, -9.81),
    )  # fmt: skip
    places = np.stack(np.meshgrid(np.linspace(start, start + 0.2, 10), np.linspace(0.1, 0.4, 10)), -1).reshape(-1, 2)
    shift = np.stack([np.concatenate([[0], np.cumsum(steps)]), np.zeros(len(steps) + 1)], -1)
    frames = torch.from_numpy(places + shift[:, None]).float()
    frames[..., 0] = frames[..., 0].remainder(1.0)
    gravity = torch.tensor([0.0, -9.81e-4])
    recording = Recording(frames, torch.zeros(100, dtype=torch.long), torch.zeros(0, 2), gravity)
    return Scenes("flow", scene, (recording,))


@pytest.mark.parametrize("turns", [-2, 1])
def test_errors_of_fields_and_shapes_do_not_depend_on_whole_periods(turns):
    scenes = flow(0.7, [0.02] * 30)  # across the border
    window, measures = scenes.window([0]), tiny_sweep().measures
    slower = flow(0.7, [0.02] + [0.015] * 29).window([0]).target
    found = measure_errors(scenes.scene, window, slower, measures)
    turned = measure_errors(scenes.scene, window, slower + torch.tensor([float(turns), 0.0]), measures)
    assert 0.1 < found["field"] < 0.9
    for name in ("field", "crowding", "height"):
        np.testing.assert_allclose(turned[name], found[name], rtol=1e-3, atol=1e-6)


def test_positions_beyond_a_wall_count_at_the_border_and_beyond_a_period_on_the_other_side():
    scene = flow(0.0, [0.01]).scene
    inside = into_domain(scene, torch.tensor([[1.25, 0.5], [-2.25, 1.5], [0.5, -0.5]]))
    torch.testing.assert_close(inside, torch.tensor([[0.25, 0.5], [0.75, 1.0], [0.5, 0.0]]))


def test_thumbnails_show_particles_within_the_period():
    scenes = flow(0.7, [0.02] * 30)
    position = scenes.recordings[0].frames[-1]
    turned, shown = (
        np.frombuffer(base64.b64decode(thumbnail(scenes, position + shift)), np.uint8).astype(int)
        for shift in (torch.tensor([3.0, 0.0]), torch.zeros(2))
    )
    assert np.abs(turned - shown).max() <= 1  # of 256 steps, by rounding


def test_rest_is_found_across_a_periodic_border():
    slowing = 0.02 * 0.8 ** np.arange(40)
    assert flow(0.9, slowing).moving_frames(0) == flow(0.1, slowing).moving_frames(0) < 30


@pytest.mark.parametrize(
    "facts",
    [
        {"bounds": ((0.0, 1.0), (0.05, 1.0))},
        {"domain": ((0.0, 1.0), (-0.1, 1.1))},
        {"boundary": ("wall", "wall")},
        {"particle_volume": 2e-3},
        {"dt": 0.02},
    ],
    ids=lambda facts: next(iter(facts)),
)
def test_errors_are_measured_anew_where_a_fact_of_the_scene_is_another(facts, tmp_path):
    scenes, store, measures = flow(0.1, [0.01] * 8), Store(tmp_path), tiny_sweep().measures
    choice = TrivialChoice("free fall")
    list(measure_accuracy(choice, scenes, measures, store))
    assert known_accuracy(choice, scenes, measures, store)[0]
    other = dataclasses.replace(scenes, scene=dataclasses.replace(scenes.scene, **facts))
    assert known_accuracy(choice, other, measures, store) == [{}]


def test_digests_tell_fields_apart():
    scenes = flow(0.1, [0.01] * 8)

    def with_fields(**fields):
        heated = dataclasses.replace(scenes.recordings[0], fields=fields)
        return dataclasses.replace(scenes, recordings=(heated,)).digests

    cold, warm = torch.zeros(9, 100), torch.ones(9, 100)
    found = [with_fields(**fields) for fields in ({}, {"heat": cold}, {"heat": warm}, {"salt": warm})]
    assert len(set(found)) == 4
    assert with_fields(heat=warm, salt=cold) == with_fields(salt=cold, heat=warm)


def test_times_are_per_frame_that_is_computed(scenes, choices, monkeypatch, tmp_path):
    timed = [choices[0], named(choices, "carried"), named(choices, "carried, batch 2"), named(choices, "free fall")]
    ticks = itertools.count()  # each rollout takes a second
    monkeypatch.setattr("nmpm.evaluation.trade.timing.clock_for", lambda *_: ("a clock", lambda: next(ticks)))
    timing, store = Timing(rounds=1, frames=3), Store(tmp_path)
    list(measure_times(timed, timed[0], scenes, timing, store))
    frames = [1e3 / known_times(choice, scenes, timing, store).milliseconds[0] for choice in timed]
    assert frames == pytest.approx([4, 4, 8, 3])  # one more; a bundle of 2 more, of one and of two scenes; as asked


def test_what_the_machine_cannot_do_is_raised_and_tried_again(scenes, tmp_path):
    def exhaust(_):
        raise ConfigError("the network cannot be compiled") from MemoryError()

    sweep, store = tiny_sweep(), Store(tmp_path)
    bad = Made("machine", exhaust)
    with pytest.raises(ConfigError, match="cannot be compiled"):
        list(measure_accuracy(bad, scenes, sweep.measures, store))
    with pytest.raises(ConfigError, match="cannot be compiled"):
        list(measure_times([bad], bad, scenes, sweep.timing, store))
    bad.make = lambda target: target
    (point,) = measure([bad], scenes, sweep, store, lambda _: None)
    assert point.competes
