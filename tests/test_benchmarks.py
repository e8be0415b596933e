"""The benchmark scripts start, share their options, and time and log as they say; no timing is asserted."""

import argparse
import contextlib
import dataclasses
import io
import json
import runpy
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import torch
from scenes import cloud

from nmpm.data import catalog
from nmpm.data.simulation import generate
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Scene
from nmpm.sim import load_preset

ROOT = Path(__file__).parent.parent / "benchmarks"
if not ROOT.is_dir():
    pytest.skip("benchmarks are not part of this distribution", allow_module_level=True)
pytestmark = pytest.mark.slow
SCRIPTS = sorted(path.stem for path in ROOT.glob("*.py") if 'if __name__ == "__main__":' in path.read_text())
CPU = torch.device("cpu")
TINY = {"preset": "waterramps", "particles": 30, "batch": 2, "width": 4, "device": CPU}


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
    assert run_script(name, "--help").startswith(f"usage: {name}.py")


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


def test_json_has_devices_and_spreads_as_plain_values(tmp_path):
    import timing

    path = tmp_path / "figures.json"
    timing.write_json(path, {"device": torch.device("cpu"), "seconds": timing.Spread.of([1.0, 3.0, 2.0])})
    assert json.loads(path.read_text()) == {"device": "cpu", "seconds": {"median": 2.0, "least": 1.0, "most": 3.0}}


def test_a_failing_process_ends_the_measurement():
    import timing

    with pytest.raises(EOFError):
        timing.time_in_processes({"broken": partial(int, "x")}, rounds=1, threads=1)


def test_training_steps_of_all_setups_change_the_weights():
    import workloads

    for name, setup in workloads.SETUPS.items():
        step = workloads.TrainingStep(setup, **TINY, unroll=2, cells=16)
        particles = step.window.frames.shape[2]
        assert step.predict().shape == (2, 2 * workloads.FRAMES, particles, 2), name
        before = [weight.clone() for weight in step.emulator.parameters()]
        step()
        assert any(not torch.equal(old, new) for old, new in zip(before, step.emulator.parameters(), strict=True)), name


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


@pytest.mark.parametrize("name", ["parts", "paper"])
def test_every_variant_of_a_sweep_builds_a_model(name):
    import ablation

    sweep = ablation.Sweep.read(ROOT / "sweeps" / f"{name}.yaml")
    scene = load_preset("goop").scene
    for variant in sweep.variants:
        config = sweep.config_of(variant)
        emulator = ablation.build_module(config, scene).emulator.eval()
        with torch.no_grad():
            bundle = emulator(cloud(scene))
        assert bundle.position.shape == (1, config["model"]["frames"], 30, 2), variant
        assert bundle.position.isfinite().all(), variant


def test_two_ranks_on_a_cpu_give_a_scaling_table(make_dataset, tmp_path):
    data, sizes = make_dataset(train=((50, 9),) * 4), ("--batch", "1", "--width", "4", "--steps", "1", "--rounds", "2")
    words = ("--device", "cpu", "--data", str(data), *sizes, "--json", str(tmp_path / "ranks.json"))
    lines = run_script("ranks", *words).splitlines()
    assert [line.split()[0] for line in lines[1:]] == ["ranks", "1", "2"]
    one, two = json.loads((tmp_path / "ranks.json").read_text())["rows"]
    assert two["windows_per_s"]["median"] == pytest.approx(2 / two["round_s"]["median"])
    assert lines[2].split()[3] == "1"  # the efficiency of one rank
    assert one["round_s"]["least"] <= one["round_s"]["median"] <= one["round_s"]["most"]


def test_a_tree_equals_itself():
    text = run_script("frozen", str(ROOT.parent), "--only", "rollouts", "--models", "goop", "--rounds", "2")
    assert [line.split("  ")[-1].count("ms a frame") for line in text.splitlines()[1:]] == [1] * 4
    assert text.count(" 0.0e+00  0.0e+00 ") == 4


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


def test_graph_networks_have_all_near_pairs_and_do_not_depend_on_place_and_order():
    from graph_network import GraphSimulator, Neighbours, radius_graph

    bounds, domain = ((-100.0, 100.0),) * 2, ((-101.0, 101.0),) * 2
    scene = Scene(bounds=bounds, domain=domain, dt=0.1, materials=("water",), particle_volume=1e-2)
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(40, 2, generator=generator)
    near = (torch.cdist(position.double(), position.double()) <= 0.2) & ~torch.eye(40, dtype=torch.bool)
    linked = torch.zeros_like(near)
    linked[tuple(radius_graph(position, 0.2))] = True
    assert torch.equal(linked, near)
    with pytest.raises(DataError, match="collapsed"):
        radius_graph(torch.zeros(300, 2), 0.5)
    simulator = GraphSimulator(scene, width=16, steps=3).eval()
    history = position.unsqueeze(1) + 0.02 * torch.rand(40, 6, 2, generator=generator)
    around = Neighbours(torch.zeros(40, dtype=torch.int64), torch.zeros(0, 2), torch.zeros(2))
    order, shift = torch.randperm(40, generator=generator), torch.tensor([0.5, -0.25])  # far from all walls
    expected = simulator.advance(history, around)
    torch.testing.assert_close(simulator.advance(history[order], around), expected[order], atol=1e-5, rtol=0)
    torch.testing.assert_close(simulator.advance(history + shift, around), expected + shift, atol=1e-5, rtol=0)


def test_ensembles_are_scored_beside_those_of_the_simulator(tmp_path):
    generate(
        load_preset("waterramps").with_frames(12), tmp_path / "data", {"train": 0, "valid": 0, "test": 2}, workers=1
    )
    words = [
        "--models",
        "waterramps:one",
        "waterramps:0.1",
        "--members",
        "2",
        "--frames",
        "4",
        "--simulator-scenes",
        "1",
    ]
    written = run_script("ensembles", str(tmp_path / "data"), *words, "--out", str(tmp_path / "out"))
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "ensembles.json", "ensembles.md", "members.png", "ranks.png",
    }  # fmt: skip
    scores = json.loads((tmp_path / "out" / "ensembles.json").read_text())["scenes"]
    assert [len(rows) for rows in scores.values()] == [2, 2, 1]
    assert "Fair CRPS of the density, over that of waterramps:one" in written
