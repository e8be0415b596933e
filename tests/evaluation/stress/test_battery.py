import dataclasses
import importlib
import json
import math

import pytest
import torch
from scenes import box, cloud

from nmpm.data.initial_states import lattice, state_at_rest, thrown_blocks
from nmpm.data.simulation import seed_of_draw
from nmpm.decoders import Absolute
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.input_checks import beyond_walls
from nmpm.emulator.rollouts import rollout
from nmpm.errors import UnstableError
from nmpm.evaluation.stress import GROUPS, Line, Size, Subject, battery
from nmpm.evaluation.stress.precision import growth, nudge
from nmpm.evaluation.stress.report import as_json, summary, write
from nmpm.evaluation.stress.settling import compare_shapes
from nmpm.evaluation.stress.sizes import widen_scene
from nmpm.evaluation.stress.subject import simulate_beside, simulate_scenes, simulate_window
from nmpm.evaluation.stress.trace import Trace, energy_above_lowest, filled_volume, is_lost, rms_distance, trace_bundles
from nmpm.processors import Pointwise
from nmpm.sim import MpmPreset, load_preset
from nmpm.sim.predictability import twin_of

TINY = Size(
    scenes=1,
    horizons=2,
    far=16,
    settling=1,
    settled=16,
    compared=8,
    particles=100,
    bundles=4,
    settling_scenes=2,
    settling_multiples=(0.5, 1.0),
)  # fmt: skip
QUIET = Constraints(energy=True, rest_speed=0.05)


def emulator_of(scene, cells=32, constraints=QUIET, scale=1e-3) -> Emulator:
    torch.manual_seed(0)
    emulator = EmulatorRecipe(scene, cells, 4, processor=Pointwise(hidden=(4,)), constraints=constraints).build().eval()
    emulator.output_scale.fill_(scale)
    return emulator


def goop(**options) -> Subject:
    preset = dataclasses.replace(
        load_preset("goop"),
        frames=20,
        blocks=dataclasses.replace(load_preset("goop").blocks, particles=(200, 260), number=(1, 1)),
    )
    return Subject("tiny", emulator_of(preset.scene, 64, **options), 8, preset)


def recorded() -> Subject:
    return Subject("recorded", emulator_of(box(gravity=None), constraints=Constraints()), 8)


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("subject", [goop(), recorded()], ids=["simulated", "recorded"])
def test_every_group_says_what_it_measured(group, subject):
    lines = list(battery(subject, TINY, {group: GROUPS[group]}))
    assert lines
    names = [line.name for line in lines]
    assert len(set(names)) == len(names)
    for line in lines:
        assert line.passed in (True, False, None)
        assert line.passed is None or line.needs
        assert all(isinstance(value, float | int) for value in line.figures.values())
    judged = [line for line in lines if line.passed is not None]
    if group in ("poison", "obstacles"):
        assert all(line.passed for line in judged), [line for line in judged if not line.passed]


def test_a_subject_with_a_simulator_is_compared_with_it():
    (line, *_) = battery(goop(), TINY, {"speeds": GROUPS["speeds"]})
    assert 0 < line.figures["mse"] < line.figures["mse_nothing_moves"]


def test_the_simulator_itself_settles_as_its_recordings_and_its_twin_stands_beside():
    subject = goop()
    held, free = battery(subject, TINY, {"settling": GROUPS["settling"]})
    for line in (held, free):
        twin = {name: value for name, value in line.figures.items() if name.startswith("twin_")}
        assert set(twin) == {f"twin_{name}" for name in line.figures if not name.startswith("twin_")}
        assert {name.rsplit("_", 1)[1] for name in twin} == {"10", "20"}
        assert 0.9 < twin["twin_height_at_20"] < 1.1
    assert held.figures["twin_height_at_20"] == free.figures["twin_height_at_20"] != 1.0
    window = simulate_window(subject, subject.preset, 2, 20)
    ratios = compare_shapes(subject.emulator, window, [10, 20])
    assert held.figures["height_at_20"] == pytest.approx(ratios[20]["height"], rel=1e-4)
    unconstrained = subject.with_emulator(subject.emulator.unconstrained())
    (line,) = battery(unconstrained, TINY, {"settling": GROUPS["settling"]})
    assert line.figures == free.figures


def test_what_constraints_hide_is_reported_without_them():
    subject = goop(constraints=Constraints(energy=True, rest_speed=0.05), scale=0.5)
    held = list(battery(subject, TINY, {"long": GROUPS["long"]}))
    free = list(battery(subject, TINY, {"free": GROUPS["free"]}))
    assert held[0].passed
    assert held[0].figures["energy_gain_percent"] <= 1
    assert free[0].name == held[0].name
    assert free[0].figures["holds"] == 0
    assert free[0].figures["energy_gain_percent"] > 100
    assert {line.passed for line in free} == {None}
    bare = subject.with_emulator(subject.emulator.unconstrained())
    assert not list(battery(bare, TINY, {"free": GROUPS["free"]}))


def test_scenes_one_by_one_are_those_of_a_window():
    subject = goop()
    together = simulate_window(subject, subject.preset, 2, 5)
    for index, one in enumerate(simulate_scenes(subject, subject.preset, 2, 5)):
        count = int(one.mask.sum())
        assert torch.equal(one.target[0], together.target[index, :, :count])


def test_scenes_in_which_a_simulator_is_unstable_make_room_for_others(monkeypatch):
    subject = goop()
    entropy, simulate_from = subject.entropies(2)[1], MpmPreset.simulate_from
    bad = subject.preset.draw(seed_of_draw(entropy, 0)).position
    twin = twin_of(subject.preset)

    def blows_up(preset, start, frames, progress=None):
        if preset.substeps == twin.substeps and start.position.shape == bad.shape and (start.position == bad).all():
            raise UnstableError("blown up")
        return simulate_from(preset, start, frames, progress)

    usual = simulate_window(subject, subject.preset, 2, 5)
    monkeypatch.setattr(MpmPreset, "simulate_from", blows_up)
    first, second = (truth for truth, _ in simulate_beside(subject, subject.preset, 2, 5, [twin]))
    assert torch.equal(first.initial.position[0], usual.initial.position[0, : first.initial.position.shape[1]])
    expected = subject.preset.draw(seed_of_draw(entropy, 1)).position
    assert len(expected) == int(second.mask.sum())


def test_speeds_at_which_the_simulator_is_unstable_are_tested_without_it(monkeypatch):
    subject = goop()
    fastest = max(abs(subject.preset.draw(seed).velocity).max() for seed in range(20))
    simulate_from = MpmPreset.simulate_from

    def blows_up(preset, start, frames, progress=None):
        if abs(start.velocity).max() > 1.2 * fastest:
            raise UnstableError("blown up")
        return simulate_from(preset, start, frames, progress)

    monkeypatch.setattr(MpmPreset, "simulate_from", blows_up)
    lines = {line.name: line for line in battery(subject, TINY, {"speeds": GROUPS["speeds"]})}
    assert "mse" in lines["initial speed × 1"].figures
    assert lines["initial speed × 10"].passed is not None
    assert "mse" not in lines["initial speed × 10"].figures


def test_a_model_that_makes_energy_fails():
    subject = goop(constraints=Constraints(), scale=0.5)
    lines = list(battery(subject, TINY, {"long": GROUPS["long"]}))
    assert lines[0].passed is False
    assert lines[0].figures["energy_gain_percent"] > 100
    assert lines[1].figures["most"] < 2 * 8 + 1  # steps to failure


def test_a_course_knows_gains_losses_and_first_failures():
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


def test_growth_is_the_exponent():
    frames = torch.arange(100, dtype=torch.float64)
    assert growth(1e-6 * (0.03 * frames).exp()) == pytest.approx(3.0)


def test_a_nudge_is_a_millionth_of_the_domain():
    subject = recorded()
    state = subject.starts(1)
    by = (nudge(subject, state).position - state.position).std().item()
    assert by == pytest.approx(0.84e-6, rel=0.1)


def test_scenes_of_a_subject_are_its_simulators():
    subject = goop()
    window = simulate_window(subject, subject.preset, 2, 5)
    assert window.target.shape[1] == 5
    torch.testing.assert_close(window.initial.position, subject.starts(2).position)


def test_a_wider_scene_has_the_same_wall_layers():
    wide = widen_scene(box(), 3)
    assert wide.domain[0] == pytest.approx((0.08, 0.92 + 2 * 0.84))
    assert wide.domain[0][1] - wide.bounds[0][1] == pytest.approx(0.02)
    assert wide.bounds[1] == (0.1, 0.9)


def test_report_files(tmp_path):
    lines = [
        Line("long", "one", True, {"drift": 0.1}, "small", {"drift": ([0.0, 0.1], 2)}),
        Line("long", "two", False, {}, "none"),
        Line("size", "three", None, {"mse": 1e-4}),
    ]
    assert summary(lines) == "1 passed, 1 failed: two."
    plain = json.loads(as_json("goop", "quick", 1.0, lines))
    assert [line["passed"] for line in plain["lines"]] == [True, False, None]
    paths = write(tmp_path / "report", as_json("goop", "quick", 1.0, lines), lines)
    assert [path.name for path in paths] == ["stress.json", "stress.md", "stress.png"]
    assert paths[1].read_text().count("\n") == 5
    assert paths[2].read_bytes().startswith(b"\x89PNG")


def test_more_and_finer_particles_share_a_block():
    scene = box(particle_volume=0.01**2)
    coarse, fine = thrown_blocks(scene, 100, seed=3), thrown_blocks(box(particle_volume=0.005**2), 400, seed=3)
    torch.testing.assert_close(coarse.position.mean(1), fine.position.mean(1), atol=1e-5, rtol=0)


def test_lattice_fills_a_box():
    points = lattice(((0.0, 1.0), (0.0, 0.5)), 0.1)
    assert points.shape == (50, 2)
    assert points.min(0).values.tolist() == pytest.approx([0.05, 0.05])
    assert points.max(0).values.tolist() == pytest.approx([0.95, 0.45])


def test_what_fails_is_not_hidden_by_a_mean():
    gain = torch.tensor([[0.0, 0.0], [0.0, 0.5]])
    none = torch.zeros(2, 2)
    trace = Trace(gain, none, none, none, torch.zeros(2, 1, 2))
    assert trace.steps_to_failure() == [3, 2]
    assert trace.figures()["energy_gain_percent"] == 50.0


def test_one_in_the_way_of_a_model_without_walls_is_left_out():
    scene = box(domain=((0.1, 0.9),) * 2)
    subject = Subject("open", emulator_of(scene), 8)
    names = [line.name for line in battery(subject, TINY, {"obstacles": GROUPS["obstacles"]})]
    assert names == ["an inlet"]


@pytest.mark.parametrize(("group", "runs"), [("counts", "trace_rollout"), ("obstacles", "unroll")])
def test_made_up_scenes_are_not_weightless_where_gravity_varies(group, runs, monkeypatch):
    emulator = emulator_of(box(gravity=None, gravity_varies=True))
    emulator.input_std[[name.startswith("gravity") for name in emulator.scene.input_channels]] = 1.0
    module, pulls = importlib.import_module(f"nmpm.evaluation.stress.{group}"), []
    run = getattr(module, runs)

    def noting(model, state, *rest):
        pulls.append(state.gravity)
        return run(model, state, *rest)

    monkeypatch.setattr(module, runs, noting)
    assert list(battery(Subject("turned", emulator, 8), TINY, {group: GROUPS[group]}))
    assert pulls
    assert all((pull[:, 1] < 0).all() and (pull[:, 0] == 0).all() for pull in pulls)


def test_absolute_models_are_taken_too():
    scene = box()
    torch.manual_seed(0)
    emulator = EmulatorRecipe(scene, 16, 4, processor=Pointwise(hidden=(4,)), decoder=Absolute()).build().eval()
    assert rollout(emulator, cloud(scene), 4).isfinite().all()
    assert list(battery(Subject("absolute", emulator, 8), TINY, {"precision": GROUPS["precision"]}))


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
