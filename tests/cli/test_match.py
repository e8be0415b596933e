"""Data in foreign units, with foreign names: commands match them to a model, say how, or refuse them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from nmpm._support.shipped import shipped_folder
from nmpm.cli import main
from nmpm.cli.run_training import EmulatorCLI
from nmpm.data.format import Split, read_metadata, write_metadata, write_split
from nmpm.scene import Reading
from nmpm.zoo import Zoo
from tests.cli.test_training_commands import TINY
from tests.made_up import made_up_metadata, made_up_trajectory

LINES = ("cells", "frames", "gravity", "particles", "materials")


def write_foreign(frames: int = 32, every: int = 1, **changes) -> Path:
    """Trajectories in millimetres and milliseconds of a material that no model has; frames are `every` of the zoo's."""
    for name in ("train", "valid", "test"):
        run = made_up_trajectory(frames * every, 9, seed=len(name), statics=4)
        position = 1000 * run.position[::every] + 250
        write_split(Path("grains", f"{name}.h5"), [run.__class__(position, run.particle_type, run.attributes)] * 2)
    units = {"bounds": ((350.0, 1150.0),) * 2, "dt": 2.5 * every, "gravity": (0.0, -9.81e-3)}
    names = {"particle_types": {3: "floor", 7: "steel"}, "particle_volume": 51.0}
    write_metadata(Path("grains"), made_up_metadata(**(units | names | changes)))
    return Path("grains")


def said_lines(text: str) -> list[str]:
    return [line.split()[0] for line in text.splitlines() if line.startswith("  ") and line.split()[0] in LINES]


def test_a_rollout_takes_data_in_other_units_and_writes_their_frames_and_names(capsys):
    data = write_foreign()
    assert main(["rollout", "goop", "--data", str(data)]) == 0
    said = capsys.readouterr().out
    assert "goop takes these data as follows." in said
    assert said_lines(said) == list(LINES)
    assert "steel -> goop" in said
    assert "30 frames" in said
    assert "nothing moves" in said
    recorded, written = Split(data / "test.h5").read(0).position, Split(Path("out.h5")).read(0)
    assert written.position.shape == recorded.shape
    np.testing.assert_allclose(written.position[:2], recorded[:2], rtol=1e-5)
    assert json.loads(written.attributes["particle_types"])["7"] == "steel"  # the data's own number
    assert json.loads(written.attributes["scene"])["dt"] == 2.5


@pytest.mark.parametrize(
    ("model", "statics", "changes", "line"),
    [
        ("goop", 0, {}, None),
        ("goop", 0, {"particle_volume": 1e-4}, "particles"),
        ("goop", 4, {}, "solid channel"),
        ("universal", 0, {"bounds": Zoo.load("universal").scene.bounds}, "gravity"),
    ],
    ids=["same", "larger particles", "obstacles", "gravity of its own"],
)
def test_data_in_the_models_units_need_no_match_only_if_nothing_differs(model, statics, changes, line, capsys):
    write_split(Path("grains", "test.h5"), [made_up_trajectory(8, 9, statics=statics)])
    write_metadata(
        Path("grains"), made_up_metadata(**({"particle_volume": Zoo.load("goop").scene.particle_volume} | changes))
    )
    assert main(["rollout", model, "--data", "grains"]) == 0
    said = capsys.readouterr().out
    assert ("as follows" in said) == (line is not None)
    assert line is None or line in said


def test_a_rollout_makes_frames_between_those_of_the_data_or_jumps_over_some(capsys):
    data = write_foreign(every=4)
    assert main(["rollout", "goop", "--data", str(data), "--out", "quarter.h5"]) == 0
    said = capsys.readouterr().out
    assert "1 frame of the model = 1/4 of the data" in said
    assert "120 frames. At most" in said
    written = Split(Path("quarter.h5"))
    assert written.frames(0) == 32
    assert read_metadata(data).dt == json.loads(written.read(0).attributes["scene"])["dt"] == 10.0
    assert main(["rollout", "goop", "--data", str(data), "--stride", "2", "--out", "second.h5"]) == 0
    captured = capsys.readouterr()
    assert "warning: Gravity of grains is" in captured.out + captured.err
    recorded, jumped = Split(data / "test.h5").read(0).position, Split(Path("second.h5")).read(0)
    np.testing.assert_allclose(jumped.position[:2], recorded[[0, 2]], rtol=1e-5)
    assert len(jumped.position) == 16


def test_walls_of_particles_may_be_thicker_than_the_model_s(capsys):
    """Those beyond its grid are left out there, not in what is written."""
    data = write_foreign(domain=((-500.0, 2000.0),) * 2)
    run = Split(data / "test.h5").read(0)
    run.position[:, run.particle_type == 3] = [-400.0, 600.0]
    write_split(data / "test.h5", [run])
    with pytest.warns(UserWarning, match=r"4 obstacle particles beyond the grid's walls are left out"):
        assert main(["rollout", "goop", "--data", str(data)]) == 0
    assert Split(Path("out.h5")).read(0).position.shape[1] == 13


def test_strict_refuses_what_does_not_match(capsys):
    data = write_foreign(gravity=(7e-3, -7e-3))  # no axis has all of it
    words = ["rollout", "goop", "--data", str(data)]
    assert main(words) == 0
    assert "turn the data" in capsys.readouterr().out
    assert main([*words, "--strict"]) == 1
    assert "turn the data" in capsys.readouterr().err
    fit = ["fit", "--start_from", "goop", "--data.path", str(data), "--trainer.max_steps", "1", "--strict"]
    assert main(fit) == 1
    assert "turn the data" in capsys.readouterr().err


def test_a_fine_tuning_needs_no_configuration_and_its_run_needs_no_zoo(capsys, monkeypatch):
    data = write_foreign()
    assert main(["fit", "--start_from", "goop", "--data.path", str(data), *TINY]) == 0
    said = capsys.readouterr().out
    assert said_lines(said) == list(LINES)
    assert "Left out" not in said
    run, goop = Path("runs/grains"), Zoo.load("goop").emulator.recipe
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["model"]["cells"] == list(goop.cells)
    assert config["model"]["processor"] == goop.to_dict()["processor"]
    assert config["model"]["constraints"] == goop.to_dict()["constraints"]
    assert config["data"]["reading"]["materials"] == {"steel": "goop"}
    assert not {"start_from", "materials", "stride", "strict"} & config.keys()
    with monkeypatch.context() as without_zoo:
        without_zoo.setattr("nmpm.cli.matched_run.load_model", None)
        assert main(["fit", "--resume", str(run), "--trainer.max_steps", "3"]) == 0
        assert main(["test", str(run)]) == 0
    report = json.loads((run / "report.json").read_text())
    assert report["training"]["steps"] == 3
    assert 0 < report["test"]["mse"] < 1e6
    assert main(["rollout", "runs/grains", "--data", str(data), "--frames", "4"]) == 0


def test_a_run_is_tested_on_data_of_another_kind(capsys, make_dataset):
    own = make_dataset(train=((30, 9),) * 2, valid=((30, 9),), test=((30, 9),), particle_volume=4e-5)
    assert main(["fit", "--start_from", "goop", "--data.path", str(own), *TINY]) == 0
    assert yaml.safe_load(Path("runs/dataset/config.yaml").read_text())["data"]["reading"] is None
    assert said_lines(capsys.readouterr().out) == []
    errors = []
    for data in (own, write_foreign(30)):
        assert main(["test", "runs/dataset", "--data.path", str(data)]) == 0
        errors.append(json.loads(Path("runs/dataset/report.json").read_text())["test"]["mse"])
    assert said_lines(capsys.readouterr().out) == list(LINES)
    assert errors[1] > 1e4 * errors[0]  # in mm²


def test_a_configuration_s_form_is_left_out_with_a_line(monkeypatch):
    built = []
    monkeypatch.setattr(EmulatorCLI, "_run_subcommand", lambda cli, _: built.append(cli))
    words = ["fit", "--config", "tutorial.yaml", "--start_from", "multimaterial", "--data.path", str(write_foreign())]
    words += ["--model.mirror=[]", "--model.frames", "16", "--materials", "steel=sand", "--stride", "1/16"]
    assert main([*words, *TINY]) == 0
    (cli,), recipe = built, Zoo.load("multimaterial").emulator.recipe
    assert "Left out of the configuration, as multimaterial has its own: model.cells, model.frames" in str(cli.matched)
    assert cli.model.emulator.recipe.processor == recipe.processor
    assert cli.model.emulator.scene.materials == recipe.scene.materials
    assert cli.model.unroll * recipe.frames == cli.datamodule.horizon >= 16  # to the next frame of the data


def test_on_data_of_its_own_a_model_changes_nothing_of_its_configuration(monkeypatch, make_dataset):
    built = []
    monkeypatch.setattr(EmulatorCLI, "_run_subcommand", lambda cli, _: built.append(cli))
    data = make_dataset(train=((40, 9),), valid=((40, 9),), particle_volume=5.1e-5)
    assert main(["fit", "--config", "goop.yaml", "--start_from", "goop", "--data.path", str(data), *TINY]) == 0
    (cli,) = built
    assert str(cli.matched) == ""
    assert cli.config["fit"]["model"]["cells"] == 32
    assert cli.datamodule.reading == Reading(cli.datamodule.data_source.scene)


def test_models_are_compared_on_data_of_another_kind(capsys, monkeypatch):
    sweep = (
        "{scenes: 2, timing: {rounds: 1, frames: 4}, models: {precision: [float32], constraints: [held], batch: [1]}}"
    )
    monkeypatch.setattr("nmpm.evaluation.trade.shipped_sweep_text", lambda _: sweep)
    data = write_foreign(every=4)
    words = ["compare", "goop", "multimaterial", "--data", str(data), "--out", "out"]
    assert main(words) == 1
    assert "State which is which: --materials steel=" in capsys.readouterr().err
    assert main([*words, "--materials", "steel=clay"]) == 1
    assert "no model has clay; they have goop, sand, water" in capsys.readouterr().err
    assert main([*words, "--materials", "steel=sand"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "goop (of other scenes): what differs from those of its training: bounds, domain, dt, gravity" in said
    assert "taken as 4 frames for 1 of the data, gravity ×" in said
    assert "multimaterial (of other scenes): what differs" in said
    assert "free fall" in said


FACTS = ("--types", "7=steel,3=spoon", "--prescribed", "3", "--bounds", "350:1150,350:1150")
"""Of `write_stirred`."""


def write_stirred() -> Path:
    """As `write_foreign`, of one trajectory whose obstacles move, in a file that names no types and no box."""
    run = Split(write_foreign() / "test.h5").read(0)
    run.position[:, run.particle_type == 3] += np.linspace(0, 20, len(run.position), dtype=np.float32)[:, None, None]
    facts = {"dt": 2.5, "gravity": (0.0, -9.81e-3)}
    np.savez("stirred.npz", position=run.position, types=run.particle_type, **facts)
    return Path("stirred.npz")


def test_a_rollout_takes_facts_that_files_lack(capsys):
    data = write_stirred()
    assert main(["rollout", "goop", "--data", str(data), *FACTS]) == 0
    assert "steel -> goop (the only material of goop); obstacles -> solid channel" in capsys.readouterr().out
    written = Split(Path("out.h5")).read(0)
    moved = np.ptp(written.position[:, 9:], axis=0)
    np.testing.assert_allclose(moved, 20, rtol=0.05)
    assert main(["rollout", "goop", "--types", "7=steel"]) == 1
    assert "--types=7=steel is about recorded data: give --data too" in capsys.readouterr().err


def test_models_are_compared_on_data_with_facts_that_files_lack(capsys, monkeypatch):
    sweep = "{scenes: 1, timing: {rounds: 1, frames: 4}, models: {precision: [float32], batch: [1]}}"
    monkeypatch.setattr("nmpm.evaluation.trade.shipped_sweep_text", lambda _: sweep)
    write_stirred()
    for split in ("train", "test"):
        Path("stirred", split).mkdir(parents=True)
        shutil.copy("stirred.npz", Path("stirred", split))
    words = ["compare", "goop", "--data", "stirred", "--out", "out"]
    assert main([*words, *FACTS]) == 0
    assert "what differs from those of its training: bounds" in " ".join(capsys.readouterr().out.split())
    assert main(["compare", "goop", "--data", "goop", "--gravity=0,-1"]) == 1
    assert "--gravity: the scenes of goop are simulated" in capsys.readouterr().err


def test_models_of_a_zoo_are_ranked_by_what_they_predict_of_data(capsys):
    for name in ("goop", "multimaterial", "waterdrop3d"):
        shutil.copytree(shipped_folder("zoo") / name, Path("zoo", name))
    data = write_foreign(24, every=2)
    assert main(["zoo", "match", str(data), "--root", "zoo"]) == 0
    said = capsys.readouterr().out
    assert "grains, 2-D models: errors at 22 frames" in said
    for row in ("goop", "multimaterial", "nothing moves", "free fall"):
        assert row in said
    assert "waterdrop3d" not in said
    last = said.splitlines()[-1]
    assert last.startswith("to start from it: nmpm fit --start_from ")
    assert last.endswith(f" --data.path {data}") if " goop " in last else "--materials steel=" in last


def test_models_are_ranked_by_data_whose_facts_are_stated(capsys):
    shutil.copytree(shipped_folder("zoo") / "goop", Path("zoo", "goop"))
    data = write_foreign(24, gravity=None)
    assert main(["zoo", "match", str(data), "--root", "zoo", "--gravity=0,-9.81e-3"]) == 0
    *_, first, use, start = capsys.readouterr().out.splitlines()
    assert first == f"first state it:   nmpm convert {data} grains-stated --gravity=0,-0.00981"
    assert use == "as it is:         nmpm rollout goop --data grains-stated"
    assert start == "to start from it: nmpm fit --start_from goop --data.path grains-stated"
    assert main(first.split()[4:]) == 0
    assert main(["rollout", "goop", "--data", "grains-stated", "--frames", "4"]) == 0
    assert "gravity    0.00" in capsys.readouterr().out


def test_messages_name_converted_data_as_the_user_does(capsys):
    shutil.move(write_foreign(24), "mm")
    assert main(["convert", "mm", "grains.npz", "--trajectory", "0"]) == 0
    assert main(["rollout", "goop", "--data", "grains.npz", "--frames", "4"]) == 0
    said = capsys.readouterr()
    assert "grains-" not in said.out + said.err


@pytest.mark.slow
def test_all_models_are_ranked_on_grains_of_another_program(recorded, capsys, monkeypatch):
    monkeypatch.delenv("NMPM_HOME")
    data = recorded / "third-party" / "lammps-grains"
    assert main(["zoo", "match", str(data)]) == 0
    said = capsys.readouterr().out
    assert "errors at 32 frames" in said
    assert "to start from it: nmpm fit --start_from" in said
