import dataclasses
import importlib
import json
import math
from fractions import Fraction

import pytest
import torch
from scenes import box, cloud

from nmpm.data.simulation import seed_of_draw
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.monitor import beyond_walls
from nmpm.emulator.similarity import find_match
from nmpm.errors import UnstableError
from nmpm.evaluation.stress import GROUPS, results
from nmpm.evaluation.stress.model import ModelUnderTest, battery, simulate_beside, simulate_window
from nmpm.evaluation.stress.results import Effort
from nmpm.evaluation.stress.trace import energy_above_lowest, filled_volume, is_lost, rms_distance, trace_bundles
from nmpm.particles import lattice, state_at_rest
from nmpm.processors import Pointwise
from nmpm.sim import MpmPreset, load_preset
from nmpm.sim.preset import twin_of

TINY = Effort(
    scenes=1, horizons=2, far=16, settling=1, settled=16, compared=8, particles=100, bundles=4, settling_scenes=2,
    settling_multiples=(0.5, 1.0),
)  # fmt: skip
QUIET = Constraints(energy=True, rest_speed=0.05)


def emulator_of(scene, cells=32, constraints=QUIET, scale=1e-3) -> Emulator:
    torch.manual_seed(0)
    emulator = EmulatorRecipe(scene, cells, 4, processor=Pointwise(hidden=(4,)), constraints=constraints).build().eval()
    emulator.output_scale.fill_(scale)
    return emulator


def goop(**options) -> ModelUnderTest:
    preset = dataclasses.replace(
        load_preset("goop"),
        frames=20,
        blocks=dataclasses.replace(load_preset("goop").blocks, particles=(200, 260), number=(1, 1)),
    )
    return ModelUnderTest("tiny", emulator_of(preset.scene, 64, **options), 8, preset)


def test_a_model_is_tested_on_scenes_of_another_kind():
    """Here sand in a wider box, in frames half as long; the simulator's are then the model's."""
    model, layout = goop(), load_preset("sandramps")
    blocks = dataclasses.replace(layout.blocks, particles=(200, 260), number=(1, 1))
    preset = dataclasses.replace(layout, frames=20, blocks=blocks)
    preset = preset.widened(2).with_stride(Fraction(1, 2))
    match = find_match(model.emulator, preset.scene, stride=Fraction(2))
    other = model.over(preset, match)
    assert other.preset.scene.dt == pytest.approx(model.preset.scene.dt)
    assert other.preset.frames == 20
    window = simulate_window(other, other.preset, 2, 5)
    assert window.target.shape[1] == 5
    assert window.initial.material.max() == 0  # goop to the model
    assert set(window.initial.obstacle.shape[1:]) != {0}
    results = {result.name: result for result in battery(other, TINY, ("speeds", "sizes", "settling"))}
    for name in ("initial speed × 1", "gravity × 2", "domain 2 × as wide", "grid refined"):
        assert 0 < results[name].figures["mse"] < 10 * results[name].figures["mse_nothing_moves"], name
    assert model.over(model.preset, find_match(model.emulator, model.preset.scene)).reading is None


def recorded() -> ModelUnderTest:
    return ModelUnderTest("recorded", emulator_of(box(gravity=None), constraints=Constraints()), 8)


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("model", [goop(), recorded()], ids=["simulated", "recorded"])
def test_every_group_says_what_it_measured(group, model):
    tested = list(battery(model, TINY, [group]))
    assert tested
    names = [result.name for result in tested]
    assert len(set(names)) == len(names)
    for result in tested:
        assert result.passed is None or result.needs
        assert all(isinstance(value, float | int) for value in result.figures.values())
    judged = [result for result in tested if result.passed is not None]
    if group in ("poison", "obstacles"):
        assert all(result.passed for result in judged), [result for result in judged if not result.passed]
    if group == "speeds" and model.preset:
        assert 0 < tested[0].figures["mse"] < tested[0].figures["mse_nothing_moves"]


def test_shapes_stand_beside_the_simulators_and_its_twins():
    model = goop()
    held, free = battery(model, TINY, ["settling"])
    for result in (held, free):
        twin = {name: value for name, value in result.figures.items() if name.startswith("twin_")}
        assert set(twin) == {f"twin_{name}" for name in result.figures if not name.startswith("twin_")}
        assert {name.rsplit("_", 1)[1] for name in twin} == {"10", "20"}
        assert 0.9 < twin["twin_height_at_20"] < 1.1
    bare = model.with_emulator(model.emulator.unconstrained())
    (result,) = battery(bare, TINY, ["settling"])
    assert result.figures == free.figures


def test_a_model_that_makes_energy_fails_and_constraints_do_not_hide_it():
    model = goop(scale=0.5)
    bare = model.with_emulator(model.emulator.unconstrained())
    held, made = (list(battery(each, TINY, ["long"])) for each in (model, bare))
    assert held[0].passed
    assert made[0].passed is False
    assert made[0].figures["energy_gain_percent"] > 100
    assert made[1].figures["most"] < 2 * 8 + 1  # steps to failure
    alone = list(battery(model, TINY, ["free"]))
    assert alone[0].name == held[0].name
    assert alone[0].figures["holds"] == 0
    assert {result.passed for result in alone} == {None}
    assert not list(battery(bare, TINY, ["free"]))


def test_scenes_one_by_one_are_those_of_a_window_and_unstable_ones_make_room_for_others(monkeypatch):
    model = goop()
    entropy, simulate_from = model.entropies(2)[1], MpmPreset.simulate_from
    bad = model.preset.draw(seed_of_draw(entropy, 0)).position
    twin = twin_of(model.preset)
    together = simulate_window(model, model.preset, 2, 5)
    assert together.target.shape[1] == 5
    torch.testing.assert_close(together.initial.position, model.starts(2).position)
    for index, (one,) in enumerate(simulate_beside(model, model.preset, 2, 5, ())):
        assert torch.equal(one.target[0], together.target[index, :, : int(one.mask.sum())])

    def blows_up(preset, start, frames, progress=None):
        if preset.substeps == twin.substeps and start.position.shape == bad.shape and (start.position == bad).all():
            raise UnstableError("blown up")
        return simulate_from(preset, start, frames, progress)


def test_a_trace_holds_gains_and_first_failures():
    scene = box(gravity=(0.0, 0.0))
    emulator = emulator_of(scene)
    start = cloud(scene, count=4, batch=2, speed=0.0)
    start = start.with_motion(start.position, torch.full_like(start.position, 1e-3))
    steps = torch.full((2, 6, 4, 2), 1e-3)
    steps[0, 3:] = 2e-3  # four times the energy from the fourth frame on
    path = start.position.unsqueeze(1) + steps.cumsum(1)
    trace = trace_bundles(emulator, start, path.split(2, dim=1), every=2)
    assert trace.gain[0].tolist() == pytest.approx([0, 0, 0, 3, 3, 3], abs=1e-3)
    assert trace.gain[1].abs().max() < 1e-3
    assert trace.steps_to_failure() == [4, 7]
    assert trace.filled.shape == (2, 3)
    assert not trace.valid
    assert trace.speed[1].tolist() == pytest.approx([math.sqrt(2) * 1e-3 / emulator.grid.spacing[0]] * 6, rel=1e-3)


def test_who_is_outside_or_nowhere_is_lost():
    scene = box()
    position = torch.tensor([[0.5, 0.5], [0.95, 0.5], [0.5, 0.0], [float("nan"), 0.5], [0.08, 0.92]])
    assert is_lost(scene, position).tolist() == [False, True, True, True, False]
    assert beyond_walls(scene, position).tolist() == [False, True, True, False, False]
    assert not is_lost(box(boundary=("periodic", "wall"), bounds=((0.08, 0.92), (0.1, 0.9))), position[1])


def test_energy_is_that_of_a_stone():
    scene = box()
    state = state_at_rest(scene, torch.tensor([[0.5, 0.6], [0.5, 0.2]]))
    values = energy_above_lowest(scene, state, state.position[:, None], torch.full((1, 1, 2, 2), 0.001))
    expected = 0.001**2 + 9.81 * 0.0025**2 * (0.5 + 0.1) / 2
    assert values.item() == pytest.approx(expected, rel=1e-5)


def test_clumped_particles_fill_less():
    scene = box(particle_volume=0.01**2)
    emulator = emulator_of(scene)
    state = state_at_rest(scene, lattice(((0.3, 0.6), (0.3, 0.6)), 0.01))
    apart = filled_volume(emulator, state, state.position).item()
    together = filled_volume(emulator, state, 0.45 + 0.5 * (state.position - 0.45)).item()
    assert apart == pytest.approx(1.0, abs=0.05)
    assert together == pytest.approx(0.25, abs=0.1)  # its rim spreads over the cells beside


def test_report_files(tmp_path):
    tested = [
        results.TestResult("long", "one", True, {"drift": 0.1}, "small", {"drift": ([0.0, 0.1], 2)}),
        results.TestResult("long", "two", False, {}, "none"),
        results.TestResult("size", "three", None, {"mse": 1e-4}),
    ]
    assert results.summary(tested) == "1 passed, 1 failed: two."
    text = results.as_json("goop", "quick", 1.0, tested)
    assert [line["passed"] for line in json.loads(text)["lines"]] == [True, False, None]
    paths = results.write(tmp_path / "report", text, tested)
    assert [path.name for path in paths] == ["stress.json", "stress.md", "stress.png"]
    assert paths[1].read_text().count("\n") == 5
    assert paths[2].read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("group", "runs"), [("counts", "scenes.trace_rollout"), ("obstacles", "obstacles.unroll")])
def test_made_up_scenes_are_not_weightless_where_gravity_varies(group, runs, monkeypatch):
    emulator = emulator_of(box(gravity=None, gravity_varies=True))
    emulator.input_std[[name.startswith("gravity") for name in emulator.scene.input_channels]] = 1.0
    module, name = importlib.import_module(f"nmpm.evaluation.stress.{runs.split('.')[0]}"), runs.split(".")[1]
    pulls, run = [], getattr(module, name)

    def noting(model, state, *rest):
        pulls.append(state.gravity)
        return run(model, state, *rest)

    monkeypatch.setattr(module, name, noting)
    assert list(battery(ModelUnderTest("turned", emulator, 8), TINY, [group]))
    assert pulls
    assert all((pull[:, 1] < 0).all() and (pull[:, 0] == 0).all() for pull in pulls)


def test_how_far_apart_two_rollouts_are_is_in_cells_and_of_real_particles():
    scene = box()
    emulator = emulator_of(scene)
    mask = torch.tensor([[True, True], [True, False]])
    one = torch.full((2, 3, 2, 2), 0.5)
    other = one.clone()
    other[:, 1, 0, 0] += 2 * emulator.grid.spacing[0]
    other[1, :, 1] = float("nan")
    values = rms_distance(emulator.grid, mask, one, other).tolist()
    assert values == pytest.approx([0.0, 2 * math.sqrt(2 / 3), 0.0], rel=1e-5)
