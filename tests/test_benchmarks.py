"""The benchmark scripts start, share their options, and time and log as they say; no timing is asserted."""

import argparse
import contextlib
import csv
import dataclasses
import io
import json
import runpy
import shlex
import shutil
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import cloud

from nmpm.data import catalog
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.generate import generate
from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import Recording
from nmpm.emulator import EmulatorRecipe, rollout
from nmpm.errors import ConfigError, DataError
from nmpm.evaluation.trade import Kind, Scenes, make_choices, read_sweep
from nmpm.particles import Window
from nmpm.processors import Identity, UNet
from nmpm.scene import Scene
from nmpm.sim import load_preset
from nmpm.training import EmulatorModule
from nmpm.zoo import Zoo

ROOT = Path(__file__).parent.parent / "benchmarks"
if not ROOT.is_dir():
    pytest.skip("benchmarks are not part of this distribution", allow_module_level=True)
SCRIPTS = sorted(path.stem for path in ROOT.glob("*.py") if 'if __name__ == "__main__":' in path.read_text())
WITHOUT_DEVICE = {"exported", "fused_steps", "gallery", "padding", "recipes", "runtimes", "scene_costs", "windows"} | {
    "against_recordings", "beside_simulator", "bodies", "busy", "calibration", "call_profile", "cropping", "dam_break",
    "ensembles", "generalisation", "gns", "gradient_shares", "hand_over", "hidden_state",
    "installed_wheel", "kills", "precision_steps", "random_commits", "recipe_pictures", "run_time_knob",
    "settled_shape", "simulators", "stable_substeps", "stiffness", "trade_tables", "trades", "where_emulation_pays",
}  # fmt: skip
"""These measure the CPU alone: export runtimes, kernels, recipes and batches on one thread, and the simulators."""


@pytest.fixture(scope="module", autouse=True)
def folder_on_path():
    """The scripts import one another by name, as they do when run from anywhere."""
    sys.path.insert(0, str(ROOT))
    yield
    sys.path.remove(str(ROOT))


def run_script(name, *words):
    """Run a script as the main program of this process, and return what it writes."""
    out, before = io.StringIO(), sys.argv
    sys.argv = [f"{name}.py", *words]
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            runpy.run_path(str(ROOT / f"{name}.py"), run_name="__main__")
    finally:
        sys.argv = before
    return out.getvalue()


@pytest.mark.parametrize("name", SCRIPTS)
def test_help_of_every_script(name):
    if name in ("exported", "runtimes"):
        pytest.importorskip("onnxruntime")
    text = run_script(name, "--help")
    assert text.startswith(f"usage: {name}.py")
    assert "--device" in text or name in WITHOUT_DEVICE | {"streaming"}


def test_device_option_refuses_a_missing_device_by_name(capsys):
    import timing

    parser = timing.make_timing_parser(None)
    assert parser.parse_args([]).device == timing.find_device("auto")
    assert parser.parse_args(["--device", "cpu"]).device == torch.device("cpu")
    with pytest.raises(SystemExit):
        parser.parse_args(["--device", "abacus"])
    assert "device 'abacus' is not one of auto, cpu, cuda, mps" in capsys.readouterr().err


def test_alternating_runs_are_warmed_up_and_interleaved():
    import timing

    ran = []
    clock = iter(range(1000))
    actions = {name: partial(ran.append, name) for name in "ab"}
    seconds = timing.time_alternating(actions, 3, lambda: float(next(clock)), warm_up=2)
    assert ran == ["a", "b"] * 5
    assert seconds == {"a": [1.0] * 3, "b": [1.0] * 3}


def test_wall_clock_waits_for_the_gpu_and_clocks_follow_the_device(monkeypatch):
    import timing

    waited = []
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: waited.append(True))
    timing.time_run(lambda: waited.append(False))
    assert waited == [True, False, True]
    assert timing.clock_for(torch.device("cpu")) is time.process_time
    assert timing.clock_for(torch.device("cuda")) is timing.wall_clock


def test_peak_on_cuda_is_what_tensors_held_beyond_those_before(monkeypatch):
    import timing

    held = {"now": 100, "peak": 900}
    monkeypatch.setattr(torch.cuda, "synchronize", lambda _: None)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda _: held["now"])
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda _: held.update(peak=held["now"]))
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda _: held["peak"])
    assert timing.peak_bytes(lambda: held.update(peak=350), torch.device("cuda")) == 250


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_peak_on_the_cpu_counts_an_allocation():
    import timing

    size = 2**25
    assert timing.peak_bytes(lambda: torch.ones(size, dtype=torch.uint8).sum(), torch.device("cpu")) > 0.9 * size


def test_json_has_devices_and_spreads_as_plain_values(tmp_path):
    import timing

    path = tmp_path / "figures.json"
    timing.write_json(path, {"device": torch.device("cpu"), "seconds": timing.Spread.of([1.0, 3.0, 2.0])})
    assert json.loads(path.read_text()) == {"device": "cpu", "seconds": {"median": 2.0, "least": 1.0, "most": 3.0}}


def test_a_failing_process_ends_the_measurement():
    import timing

    with pytest.raises(EOFError):
        timing.time_in_processes({"broken": partial(int, "x")}, rounds=1, threads=1)


# ---- what is timed

CPU = torch.device("cpu")
TINY = {"preset": "waterramps", "particles": 30, "batch": 2, "width": 4, "device": CPU}


def test_training_steps_of_all_setups_change_the_weights():
    import workloads

    for name, setup in workloads.SETUPS.items():
        step = workloads.TrainingStep(setup, **TINY, unroll=2, cells=16)
        particles = step.window.frames.shape[2]
        assert step.predict().shape == (2, 2 * workloads.FRAMES, particles, 2), name
        before = [weight.clone() for weight in step.emulator.parameters()]
        step()
        assert any(not torch.equal(old, new) for old, new in zip(before, step.emulator.parameters(), strict=True)), name


def test_recomputed_activations_give_the_same_step():
    import workloads

    steps = [
        workloads.TrainingStep(workloads.SETUPS["ours"], **TINY, unroll=2, cells=16, recompute=recompute)
        for recompute in (False, True)
    ]
    for step in steps:
        step()
    for one, other in zip(*(step.emulator.parameters() for step in steps), strict=True):
        torch.testing.assert_close(one, other)


def test_the_setup_without_kernels_differs_from_the_shipped_one_in_what_runs_alone():
    import workloads

    names = ("ours, half as wide, tensor operations", "ours, half as wide (as shipped)")
    plain, fused = (workloads.SETUPS[name] for name in names)
    assert dataclasses.replace(plain, kernels=True) == fused
    paths = []
    for setup in (plain, fused):
        step = workloads.TrainingStep(setup, **TINY, unroll=1, cells=16)
        with setup.backend():
            paths.append(step.predict())
    torch.testing.assert_close(*paths)


def test_calls_that_are_rolled_on_predict_a_rollout():
    from rolling import roll_on, roll_to_end

    scene = load_preset("goop").scene
    torch.manual_seed(0)
    emulator = EmulatorRecipe(scene, cells=16, frames=4, processor=UNet(width=4, depth=2)).build().eval()
    state = cloud(scene, batch=2)
    with torch.no_grad():
        context = emulator.context(state)
        bundles = [bundle.position for bundle, _ in roll_on(lambda now: emulator(now, context), state, 3)]
        last = roll_to_end(lambda now: emulator(now, context), state, 3)
    torch.testing.assert_close(torch.cat(bundles, dim=1), rollout(emulator, state, 12))
    assert torch.equal(last.position, bundles[-1][:, -1])


def test_costs_of_scenes_are_drawn_again_from_stored_figures(tmp_path):
    path = tmp_path / "costs.png"
    assert run_script("scene_costs", "--redraw", str(ROOT / "scene_costs.json"), "--figure", str(path)) == ""
    assert path.read_bytes()[:4] == b"\x89PNG"


def test_repeated_rollout_calls_start_from_the_same_state():
    import workloads

    calls = workloads.RolloutCalls(workloads.SETUPS["the paper's form"], **TINY, calls=2)
    before = calls.state.position.clone()
    calls()
    assert torch.equal(calls.state.position, before)


@pytest.mark.skipif("goop" not in Zoo.list(), reason="the zoo holds no goop model")
def test_a_zoo_model_agrees_with_itself_on_the_same_device():
    import zoo_on_device

    figures = zoo_on_device.compare_devices("goop", load_preset("goop").with_frames(12), 1, CPU)
    assert figures["cells_after_8"] == figures["cells_at_end"] == 0
    assert 0 < figures["cpu"]["errors"]["mse"] < figures["cpu"]["errors"]["still/mse"]


# ---- trained runs side by side


def test_ratio_of_scaled_errors_has_no_spread_and_that_of_noise_contains_one():
    import recipes

    theirs = [1.0, 5.0, 2.0, 0.1]
    assert recipes.ratio_interval([value / 2 for value in theirs], theirs) == pytest.approx((0.5, 0.5, 0.5))
    _, low, high = recipes.ratio_interval(theirs[::-1], theirs)
    assert low < 1 < high


def test_seeds_are_averaged_scene_by_scene():
    import recipes

    rows = [{"errors": {"settings": "", "mse": [1.0, 3.0]}}, {"errors": {"settings": "", "mse": [2.0, 5.0]}}]
    assert recipes.mean_over_seeds(rows, "errors") == {"mse": [1.5, 4.0]}
    assert recipes.mean_over_seeds([*rows, {}], "errors") == {}
    assert {recipes.Run(Path(name)).recipe for name in ("goop-0", "goop-12")} == {"goop"}


def test_figures_of_a_run_are_kept_until_its_checkpoint_or_the_settings_change(tmp_path):
    import recipes

    checkpoint = tmp_path / "checkpoints" / "best.ckpt"
    checkpoint.parent.mkdir()
    checkpoint.write_bytes(b"one")
    values = iter(range(10))

    def measured(settings="", fresh=False):
        figures = recipes.Figures(recipes.Run(tmp_path), fresh)
        figures.measure("errors", settings, lambda: {"mse": next(values)})
        return figures.rows["errors"]["mse"]

    assert [measured(), measured(), measured("other"), measured("other", fresh=True)] == [0, 0, 1, 2]
    checkpoint.write_bytes(b"another")
    assert measured("other") == 3


# ---- the script that runs everything on a machine with a GPU


def test_gpu_dry_run_prints_all_steps_in_order_and_runs_nothing(tmp_path):
    lines = run_script("gpu", "--out", str(tmp_path / "logs"), "--dry-run").splitlines()
    steps = dict(line.split(": ", 1) for line in lines)
    assert list(steps)[:2] == ["fit", "tests"]
    assert list(steps)[-1] == "zoo"
    assert steps["fit"].endswith("nmpm fit --config goop.yaml")
    assert "pytest --device cuda tests/test_on_device.py" in steps["tests"]
    assert not (tmp_path / "logs").exists()
    started = {word for step in steps.values() for word in shlex.split(step) if word.startswith("benchmarks/")}
    own_data = {"seen_scenes"}  # given by the user as a folder
    assert {f"benchmarks/{name}.py" for name in set(SCRIPTS) - WITHOUT_DEVICE - own_data - {"gpu"}} <= started


def test_gpu_runs_only_the_steps_that_are_named(tmp_path):
    lines = run_script("gpu", "--out", str(tmp_path), "--dry-run", "--only", "zoo", "fit").splitlines()
    assert [line.split(": ")[0] for line in lines] == ["fit", "zoo"]
    with pytest.raises(ConfigError, match="There is no step zou; there are fit, tests"):
        run_script("gpu", "--dry-run", "--only", "zou")


class ParsedError(Exception):
    """Ends a script once its options are read."""


def test_gpu_steps_are_understood_by_their_scripts(tmp_path, monkeypatch):
    import gpu
    import timing

    read = argparse.ArgumentParser.parse_args

    def stop_after_parsing(parser, *words):
        raise ParsedError(read(parser, *words).device if "streaming" not in sys.argv[0] else None)

    monkeypatch.setattr(timing, "find_device", torch.device)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop_after_parsing)
    for name, (_, script, *words) in gpu.list_steps("cuda", tmp_path).items():
        if script.startswith("benchmarks/"):
            with pytest.raises(ParsedError) as parsed:
                run_script(Path(script).stem, *words)
            assert parsed.value.args[0] in (torch.device("cuda"), None), name


def test_gpu_steps_are_logged_continued_and_failures_named(tmp_path, capsys):
    import gpu

    python, marker = sys.executable, tmp_path / "marker"
    good = [python, "-c", f"open({str(marker)!r}, 'a').write('x'); print('well')"]
    bad = [python, "-c", "print('ill'); raise SystemExit(3)"]
    assert gpu.run_steps({"good": good, "bad": bad, "last": good}, tmp_path / "logs") == ["bad"]
    assert (tmp_path / "logs" / "good.log").read_text().splitlines()[1:] == ["well", "", "exit status 0"]
    assert (tmp_path / "logs" / "bad.log").read_text().endswith("ill\n\nexit status 3\n")
    assert gpu.run_steps({"good": good, "bad": good, "last": good}, tmp_path / "logs") == []
    assert marker.read_text() == "xxx"  # good and last are not run again
    assert gpu.run_steps({"good": [*good, "other"]}, tmp_path / "logs") == []
    assert marker.read_text() == "xxxx"  # another command is
    assert "good: done before" in capsys.readouterr().out


def test_gpu_runs_an_interrupted_step_again(tmp_path):
    import gpu

    log = tmp_path / "step.log"
    command = [sys.executable, "-c", "pass"]
    log.write_bytes(gpu._first_line(command) + b"half of the output")
    assert not gpu.has_succeeded(command, log)
    gpu.run_steps({"step": command}, tmp_path)
    assert gpu.has_succeeded(command, log)


def test_the_map_states_break_even_for_every_width(tmp_path):
    import where_emulation_pays

    text = run_script("where_emulation_pays", "goop", "--times", "1", "2", "--rounds", "1", "--out", str(tmp_path))
    found = json.loads((tmp_path / "map.json").read_text())
    narrow, wide = found["cases"]
    assert wide["particles"] > narrow["particles"]
    assert min(case["frame"]["median"] for case in found["cases"]) > 0
    assert "| goop × 2 | MLS-MPM, 2-D |" in text
    kept = where_emulation_pays.read_cases(tmp_path / "map.json")["goop"]
    assert [case.particles for case in kept] == [narrow["particles"], wide["particles"]]
    assert all(case.hardware for case in kept)
    assert (tmp_path / "map.png").read_bytes()[:4] == b"\x89PNG"


def test_a_cost_is_fitted_to_all_but_the_widest():
    import where_emulation_pays as script

    cases = [script.Case("", 1, count, "", 1, None, None, "") for count in (100, 200, 400)]
    fit = script.fit_cost(cases, [3.0, 5.0, 18.0])
    assert fit == pytest.approx({"offset": 1.0, "slope": 0.02, "misfit": 0.0, "check": 2.0})


def test_wide_scenes_hold_copies_of_a_narrow_one_side_by_side():
    import where_emulation_pays as script

    preset = load_preset("waterramps")
    start = preset.draw(0)
    wide = script.side_by_side(preset, start, 3)
    width, count = preset.domain[0][1] - preset.domain[0][0], len(start.position)
    assert wide.counts == (3 * count,)
    assert len(wide.obstacles) == 3 * len(start.obstacles)
    assert np.allclose(wide.position[2 * count :] - start.position, [2 * width, 0])
    assert np.array_equal(wide.velocity[:count], wide.velocity[count : 2 * count])
    assert len(preset.widened(3).simulate_from(wide, 1).position) == 2  # the wide box holds them all


def test_polygons_move_with_their_scene():
    import where_emulation_pays as script

    preset = load_preset("wbcsph")
    start = preset.draw(0)
    wide = script.side_by_side(preset, start, 2)
    width, count = preset.domain[0][1] - preset.domain[0][0], len(start.obstacles)
    assert len(wide.obstacles) == 2 * count > 0
    for own, copied in zip(start.obstacles, wide.obstacles[count:], strict=True):
        assert np.allclose(copied.corners - own.corners, [width, 0])


def test_random_commits_start_bundles_within_the_one_before():
    import random_commits as script

    model = Zoo.load("goop")
    state = model.example(count=100)
    path = model.rollout(state, 32)
    frames = torch.cat([(state.position - state.velocity).unsqueeze(1), state.position.unsqueeze(1), path], dim=1)
    window = Window(frames, state.material, state.mask, state.obstacle, state.obstacle_mask, state.gravity)
    bundle = model.emulator(state)
    after = script.state_after(bundle, state, 8)
    assert torch.equal(after.position, bundle.state_after(state).position)
    assert torch.allclose(after.velocity, bundle.velocity, atol=1e-7)
    first = script.state_after(bundle, state, 1)
    assert torch.equal(first.velocity, bundle.position[:, 0] - state.position)
    assert torch.equal(script.cut(window, 4, 8).initial.position, path[:, 3])
    assert torch.equal(script.cut(window, 4, 8).target, path[:, 4:12])

    recipe = model.emulator.recipe
    own = {field.name: getattr(recipe, field.name) for field in dataclasses.fields(recipe)}
    losses = []
    for module in (EmulatorModule(**own, unroll=4), script.RandomCommits([8], **own, unroll=4)):
        module.emulator.load_state_dict(model.emulator.state_dict())
        module.log = lambda *_: None
        losses.append(float(module.training_step(window, 0).detach()))
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)


def test_the_committed_map_has_the_points_of_the_committed_tables(tmp_path):
    shutil.copy(ROOT / "trade" / "map.json", tmp_path)
    text = run_script("where_emulation_pays", "--redraw", "--out", str(tmp_path))
    assert text.count("times as fast as") == len(list((ROOT / "trade").glob("*/trade.csv")))
    drawn, committed = (json.loads((folder / "map.json").read_text()) for folder in (tmp_path, ROOT / "trade"))
    assert (drawn["points"], drawn["cases"]) == (committed["points"], committed["cases"])


# ---- time and error beside the simulator


def write_rows(path, rows):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def write_trade(path, rows):
    names = ("kind", "name", "batch", "ms_per_frame", "stable", "value")
    common = {"dataset": "tiny", "particles": 10, "error": "mse"}
    write_rows(path, [common | dict(zip(names, row, strict=True)) for row in rows])


def test_models_are_compared_with_the_simulator_at_equal_time_and_at_equal_error(tmp_path):
    from beside_simulator import read_rivals, table_lines

    rows = [
        ("simulator", "shipped", 1, 10.0, True, 0.0),
        ("simulator", "fewer", 1, 6.0, True, 0.010),
        ("simulator", "coarse", 1, 0.5, True, 0.060),
        ("simulator", "unstable", 1, 0.6, False, ""),
        ("model", "worse", 1, 7.0, True, 0.020),
        ("model", "better", 1, 2.0, True, 0.020),
        ("model", "together", 8, 1.0, True, 0.020),
    ]
    write_trade(tmp_path / "trade.csv", rows)
    better, worse = read_rivals(tmp_path / "trade.csv")
    assert (better.model.name, better.as_fast.name, better.as_good.name) == ("better", "coarse", "fewer")
    assert (better.speed_up, better.gain, better.wins) == pytest.approx((3.0, 3.0, True))
    assert (worse.gain, worse.wins) == (0.5, False)
    assert "**better**" in list(table_lines([better, worse]))[2]


def test_the_page_of_tables_is_that_of_the_committed_measurements(tmp_path):
    run_script("trade_tables", "--page", str(tmp_path / "page.md"))
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert page == (ROOT / "trade_tables.md").read_text(encoding="utf-8")
    assert run_script("beside_simulator") in page


def test_a_table_has_stable_choices_errors_with_intervals_and_no_errors_of_unstable_ones(tmp_path):
    from beside_simulator import read_rows
    from trade_tables import group_choices, section_lines

    common = {
        "dataset": "tiny",
        "scenes": "5",
        "particles": "9",
        "threads": "1",
        "clock": "CPU time",
        "hardware": "here",
    }
    rows = [
        common | {"name": name, "ms_per_frame": ms, "ratio_to_reference": "0.5", "error": error, "value": value}
        | {"low": low, "high": high, "pareto": str(name == "goop"), "stable": str(name != "free"), "failed_scenes": "2"}
        for name, ms, error, value, low, high in [
            ("simulator, 6 substeps", "2.0", "mse", "2.00812", "1", "3"),
            ("goop", "0.1234", "mse", "0.0123", "0.01", "0.02"),
            ("goop", "0.1234", "height", "0.997", "", ""),
            ("free", "0.1", "mse", "0.5", "0.4", "0.6"),
        ]
    ]  # fmt: skip
    write_rows(tmp_path / "trade.csv", rows)
    lines = list(section_lines(group_choices(read_rows(tmp_path / "trade.csv"))))
    assert lines[2:-1] == [
        "| choice | ms | time | MSE | height |",
        "|---|---:|---:|---:|---:|",
        "| free: unstable in 2 of 5 scenes | 0.1 | 0.5 |  |  |",
        "| **goop** | 0.123 | 0.5 | 12.3 (10 – 20) | 100% |",
        "| 6 substeps | 2 | 0.5 | 2008 (1000 – 3000) |  |",
    ]


def test_tables_name_the_weights_that_were_measured_and_those_that_the_zoo_has_replaced():
    from trade_tables import Choice, weights_line

    rows = [
        {"model": "simulator", "weights": ""},
        {"model": "goop", "weights": "aaa"},
        {"model": "goop", "weights": "aaa"},
        {"model": "goop/fast (of other scenes)", "weights": "bbb"},
        {"model": "runs-mine", "weights": "ccc"},
    ]
    line = weights_line([Choice(row, {}) for row in rows], {"goop": "aaa", "goop/fast": "ddd"}.get)
    assert line == "Weights: goop aaa, goop/fast bbb (the zoo has others by now), runs-mine ccc."
    assert weights_line([Choice({"model": "goop"}, {})], {"goop": "aaa"}.get) == ""


@pytest.mark.parametrize("path", sorted((ROOT / "trade").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_sweeps_have_choices_of_their_simulator(path):
    preset = load_preset(path.stem)
    sweep = read_sweep(path.read_text(encoding="utf-8"), path.name)
    choices = make_choices(sweep, Scenes(path.stem, preset.scene, (), preset, ()), {})
    assert choices[0].name == f"simulator, {preset.substeps} substeps"
    coarse = {choice.settings["coarser"] for choice in choices if choice.kind is Kind.SIMULATOR}
    assert coarse == set(sweep.simulator.coarser)


def test_a_graph_network_is_trained_and_written_at_the_times_asked_for(tmp_path, monkeypatch):
    preset = load_preset("goop").coarsened(2).with_frames(6)
    preset = dataclasses.replace(preset, blocks=dataclasses.replace(preset.blocks, number=(1, 1), particles=(60, 80)))
    generate(preset, tmp_path / "data", {"train": 1, "valid": 1, "test": 0}, workers=1)
    monkeypatch.setattr(catalog, "ensure", lambda *_: tmp_path / "data")
    words = ("goop", "--minutes", "0.0005", "0.001", "--trajectories", "1", "--width", "4", "--out", str(tmp_path))
    text = run_script("gns", *words)
    import gns

    predictor = gns.load(preset.scene, str(tmp_path / "minutes-0.001.pt"))
    assert "0.001 min of training" in predictor.name
    assert gns.converged([(2.0, 0.402), (4.0, 0.4)])
    assert not gns.converged([(2.0, 0.5), (4.0, 0.4)])
    assert not gns.converged([(4.0, 0.4)])  # nobody knows
    state = cloud(preset.scene)
    assert predictor(state, 2).shape == (*state.position.shape[:1], 2, *state.position.shape[1:])
    with pytest.raises(ConfigError, match="other scenes: dt differ"):
        gns.load(dataclasses.replace(preset.scene, dt=1.0), str(tmp_path / "minutes-0.0005.pt"))
    assert text.count("loss") == 24
    assert run_script("gns", *words) == ""  # it goes on from the end


FREE = Scene(
    bounds=((-100.0, 100.0),) * 2, domain=((-101.0, 101.0),) * 2, dt=0.1, materials=("water",), particle_volume=1e-2
)  # fmt: skip


def test_graph_networks_have_all_near_pairs_and_do_not_depend_on_place_and_order():
    from graph_network import GraphSimulator, Neighbours, radius_graph

    generator = torch.Generator().manual_seed(0)
    position = torch.rand(40, 2, generator=generator)
    near = (torch.cdist(position.double(), position.double()) <= 0.2) & ~torch.eye(40, dtype=torch.bool)
    linked = torch.zeros_like(near)
    linked[tuple(radius_graph(position, 0.2))] = True
    assert torch.equal(linked, near)
    with pytest.raises(DataError, match="collapsed"):
        radius_graph(torch.zeros(300, 2), 0.5)
    simulator = GraphSimulator(FREE, width=16, steps=3).eval()
    history = position.unsqueeze(1) + 0.02 * torch.rand(40, 6, 2, generator=generator)
    around = Neighbours(torch.zeros(40, dtype=torch.int64), torch.zeros(0, 2), torch.zeros(2))
    order, shift = torch.randperm(40, generator=generator), torch.tensor([0.5, -0.25])  # far from all walls
    expected = simulator.advance(history, around)
    torch.testing.assert_close(simulator.advance(history[order], around), expected[order], atol=1e-5, rtol=0)
    torch.testing.assert_close(simulator.advance(history + shift, around), expected + shift, atol=1e-5, rtol=0)


def test_a_graph_network_overfits_free_fall_and_its_training_goes_on_as_if_uninterrupted():
    import gns
    from graph_network import GraphSimulator

    start, time = torch.cartesian_prod(*[0.1 * torch.arange(3.0)] * 2), torch.arange(30).view(-1, 1, 1)
    path = start - torch.tensor([0.0, 5e-4]) * time**2 + torch.tensor([0.01, 0.0]) * time
    recording = Recording(path, torch.zeros(9, dtype=torch.int64), torch.zeros(0, 2), torch.zeros(2))

    def trainer():
        torch.manual_seed(0)
        steps = iter(range(10**6))  # a clock that counts, whatever the machine's speed
        settings = gns.Training(seconds=150, noise=0.0, rate=3e-3)
        return gns.GraphTrainer(GraphSimulator(FREE, width=16, steps=2), [recording], settings, lambda: next(steps))

    whole, first, second = trainer(), trainer(), trainer()
    while not whole.done:
        whole.step()
    for _ in range(3):
        first.step()
    second.load_state_dict(first.state_dict())
    while not second.done:
        second.step()
    for name, values in whole.simulator.state_dict().items():
        assert torch.equal(second.simulator.state_dict()[name], values), name
    predicted = whole.simulator.rollout(collate([recording], FREE, 2).initial, 20)[0]
    error, distance = predicted - path[2:22], path[2:22] - path[1]
    assert float(error.abs().max()) < 0.05 * float(distance.abs().max())


def test_all_trades_are_commands_that_their_programs_understand(tmp_path):
    import trades

    text = run_script("trades", "--dry-run", "--out", str(tmp_path / "all"))
    assert [line.split(",")[0] for line in text.splitlines()] == [
        "gns", "goop", "waterramps", "dambreak2d", "waterdrop-xl", "map",
    ]  # fmt: skip
    assert not (tmp_path / "all").exists()
    steps = trades.list_steps(tmp_path)
    for name, models in trades.MODELS.items():
        words = steps[name].words
        assert set(models) <= set(words)
        assert (ROOT.parent / words[words.index("--config") + 1]).is_file()
    one = run_script("trades", "--dry-run", "--steps", "map")
    assert one.startswith("map, about")
    assert one.count("\n") == 1


def test_a_model_is_its_own_ensemble_and_commits_whole_bundles():
    import run_time_knob

    scene = load_preset("goop").scene
    torch.manual_seed(0)
    emulator = EmulatorRecipe(scene, cells=16, frames=4, processor=UNet(width=4, depth=2)).build().eval()
    state = cloud(scene, batch=2)
    expected = rollout(emulator, state, 10)
    torch.testing.assert_close(run_time_knob.knob_rollout([emulator], state, 10, 4), expected)
    torch.testing.assert_close(run_time_knob.knob_rollout([emulator] * 2, state, 10, 4), expected)
    short = run_time_knob.knob_rollout([emulator], state, 10, 2)
    torch.testing.assert_close(short[:, :2], expected[:, :2])
    assert not torch.equal(short, expected)


def test_a_shift_moves_the_grid_and_nothing_else():
    import run_time_knob

    scene = load_preset("goop").scene
    emulator = EmulatorRecipe(scene, cells=16, frames=4, processor=Identity()).build().eval()
    moved = run_time_knob.shifted(emulator, (0.25, -0.25))
    assert moved.scene.bounds == scene.bounds
    assert moved.grid.shape == emulator.grid.shape
    expected = (
        scene.domain[0][0] + 0.25 * emulator.grid.spacing[0],
        scene.domain[1][0] - 0.25 * emulator.grid.spacing[1],
    )
    assert moved.grid.lower == pytest.approx(expected)
    assert run_time_knob.shifted(emulator, (0.0, 0.0)) is emulator


def test_a_simulator_restarted_before_anything_is_strained_goes_on_as_it_was():
    from hidden_state import restart

    preset = load_preset("goop").with_frames(6)
    frames = preset.simulate(0).position
    again = restart(preset, preset.draw(0), frames[:2], 4)
    np.testing.assert_allclose(again, frames[2:6], rtol=0, atol=1e-5)


def test_a_simulator_that_takes_over_from_itself_changes_nothing():
    from hand_over import hand_over

    preset = load_preset("goop").with_frames(6)
    frames = preset.simulate(0).position
    path = hand_over(preset, preset.draw(0), frames[:3], 6)
    assert path is not None
    np.testing.assert_array_equal(path[:3], frames[:3])
    np.testing.assert_allclose(path, frames[:6], rtol=0, atol=1e-5)


def test_settled_shapes_are_compared_scene_by_scene_under_other_constraints():
    import settled_shape

    preset = load_preset("waterramps").with_frames(6)
    torch.manual_seed(0)
    emulator = EmulatorRecipe(preset.scene, cells=16, frames=4, processor=UNet(width=4, depth=2)).build().eval()
    capped = settled_shape.held_to(emulator, "density_cap=3.0,rest_speed=0.01")
    assert capped.constraints == dataclasses.replace(emulator.constraints, density_cap=3.0, rest_speed=0.01)
    rows = {"model": emulator, "capped": capped}
    scenes = list(settled_shape.measure(rows, "waterramps", [1, 4], 2))
    assert [list(scene) for scene in scenes] == [["simulator", "twin", "model", "capped"]] * 2
    assert all(values.shape == (2, 3) and (values > 0).all() for scene in scenes for values in scene.values())
    heights = np.array([1.0, 2.0, 3.0])
    assert settled_shape.ratio(1.1 * heights, heights) == "1.10 (1.10–1.10)"


@pytest.mark.parametrize("name", ["goop", "waterramps", "dambreak2d"])
def test_stiffer_materials_need_substeps_as_sound_is_faster(name):
    import stiffness

    preset = load_preset(name)
    one, hundred = (stiffness.stiffer(preset, factor) for factor in (1, 100))
    assert one.substeps == preset.stable_substeps
    if name == "waterramps":  # stiffer water is compressed less, and so stiffens less in spray
        assert 3 * one.substeps < hundred.substeps < 10 * one.substeps
    else:
        assert hundred.substeps == pytest.approx(10 * one.substeps, abs=10)


# ---- beyond a model's own scenes


def test_simulators_of_small_particles_have_cells_and_substeps_in_proportion():
    import generalisation

    preset = load_preset("waterramps")
    assert generalisation.refine(preset, 1000) == preset
    fine = generalisation.refine(preset, 10**5)
    factor = fine.cells / preset.cells
    spacing = (generalisation.FILLED * preset.scene.volume / 10**5) ** 0.5
    assert factor == pytest.approx(preset.spacing / spacing, rel=0.01)
    assert fine.substeps == pytest.approx(factor * preset.substeps, rel=0.01)


@pytest.mark.skipif("goop" not in Zoo.list(), reason="the zoo holds no goop model")
def test_times_are_per_frame_and_drawn_beside_those_of_simulators(tmp_path):
    import generalisation

    preset = load_preset("goop").coarsened(4)
    rows = generalisation.time_all({"goop": Zoo.load("goop")}, [preset], (100, 1000), rounds=1, device=CPU)
    for row in rows.values():
        assert [name.split(",")[0] for name in row] == ["goop", "simulator of goop", "simulator of goop"]
        assert all(0 < times.least <= times.median for times in row.values())
    generalisation.draw_times(tmp_path / "times.png", rows)
    assert (tmp_path / "times.png").stat().st_size > 0
    with pytest.raises(SystemExit, match="dambreak2d: only simulators of the material point method"):
        generalisation.load_mpm("dambreak2d")


def test_a_gradients_parts_sum_to_it_and_the_first_is_what_is_left_when_cut(make_dataset):
    import gradient_shares

    data = TrajectoryDataModule(path=str(make_dataset(train=((12, 40),))), horizon=6, batch_size=1)
    data.setup("fit")
    torch.manual_seed(0)
    module = EmulatorModule(data.scene, cells=8, frames=2, unroll=3, processor=UNet(width=4, depth=1, perceptron=(4,)))
    window = next(iter(data.train_dataloader()))
    found = gradient_shares.parts(module, window)
    whole, cut = (gradient_shares.gradient(module, window, factor) for factor in (1.0, 0.0))
    torch.testing.assert_close(found.sum(0), whole, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(found[0], cut, rtol=1e-6, atol=1e-9)


def test_equal_gradients_have_all_in_common_and_noise_has_nothing():
    from gradient_shares import common_share

    torch.manual_seed(0)
    equal = torch.randn(1, 2, 1000).expand(8, -1, -1)
    torch.testing.assert_close(common_share(equal), torch.ones(2))
    noise = torch.randn(8, 2, 10_000)
    assert common_share(noise).abs().max() < 0.02  # its standard deviation is 0.002
    halves = torch.randn(1, 2, 10_000) + noise
    torch.testing.assert_close(common_share(halves), torch.full((2,), 0.5), rtol=0, atol=0.05)


def test_a_rollout_from_a_late_frame_is_compared_with_what_follows_it():
    import seen_scenes

    emulator = Zoo.load("goop").emulator
    state = cloud(emulator.scene, count=40)
    path = torch.cat([state.position[:, None], rollout(emulator, state, 39)], dim=1)
    late = seen_scenes.cut(dataclasses.replace(Window.of(state), frames=path), start=8, frames=16)
    torch.testing.assert_close(late.initial.position, path[:, 9])
    torch.testing.assert_close(late.target, path[:, 10:26])
    errors, (predicted, recorded) = seen_scenes.measure_scene(emulator, late)
    own = rollout(emulator, late.initial, 16)
    assert errors == pytest.approx((own - late.target).double().square().mean((0, 2, 3)).numpy(), rel=1e-3)
    assert predicted == pytest.approx(float(own[:, 8:].diff(dim=1).double().square().mean()), rel=1e-3)
    assert recorded == pytest.approx(float(late.target[:, 8:].diff(dim=1).double().square().mean()), rel=1e-3)


def test_rows_of_seen_scenes_are_means_with_intervals_and_paired_ratios():
    import seen_scenes

    errors = np.array([[1e-3, 3e-3], [3e-3, 5e-3]])
    energies = np.array([[1.0, 2.0], [2.0, 4.0]])
    assert seen_scenes.format_row(errors, energies, [1, 100], None) == "2 |  | 3, 2–4 | 0.50"
    assert seen_scenes.format_row(errors / 2, energies, [2], errors) == "2 | 1.5, 0.50 (0.50–0.50) | 0.50"
