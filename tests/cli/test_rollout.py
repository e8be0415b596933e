import errno
import json
import os
import re
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from nmpm._support.atomic import atomic_write, file_obstacle
from nmpm._support.shipped import shipped_folder
from nmpm.cli import main
from nmpm.data.format import Split, Trajectory, write_split
from nmpm.errors import DataError
from nmpm.scene import Scene
from nmpm.viz.files import read_labelled
from tests.made_up import made_up_trajectory

BOX = ((0.1, 0.9),) * 2
SCENE = json.dumps(Scene(BOX, BOX, dt=0.0025, materials=("goop",), particle_volume=1e-4).to_dict())


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    return tmp_path


def test_names_and_paths_give_the_same_rollout(folder):
    (folder / "copy").symlink_to(shipped_folder("zoo") / "goop")
    few = ["--frames", "4", "--particles", "50"]
    assert main(["rollout", "goop", *few, "--out", "a.h5", "--device", "cpu"]) == 0
    assert main(["rollout", "./copy", *few, "--out", "b.h5"]) == 0
    assert main(["rollout", "goop", "--root", str(shipped_folder("zoo")), *few, "--out", "c.h5"]) == 0
    a, b, c = (Split(folder / f"{name}.h5").read(0).position for name in "abc")
    assert a.shape[0] == 6
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(a, c)


def test_another_runtime_gives_the_same_rollout_to_rounding(folder):
    if find_spec("openvino") is None:  # importing it would report to its makers
        pytest.skip("openvino is not installed")
    few = ["rollout", "goop", "--frames", "8", "--particles", "50"]
    for name in ("eager", "openvino"):
        assert main([*few, "--runtime", name, "--out", f"{name}.h5"]) == 0
    one, other = (Split(folder / f"{name}.h5").read(0).position for name in ("eager", "openvino"))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["goop", "--frames", "0"], "--frames 0: it must be at least 1."),
        (["goop", "--particles", "0"], "--particles 0: it must be at least 1."),
        (["goop", "--particles", "-5"], "--particles -5: it must be at least 1."),
        (["goop", "--blocks", "0"], "--blocks 0: it must be at least 1."),
        (["goop", "--seed", "-1"], "--seed -1: it must be at least 0."),
        (["goop", "--trajectory", "-1"], "--trajectory -1: it must be at least 0."),
        (["goop", "--particles", "1000000"], "--particles 1000000: 1 blocks of"),
        (["goop", "--particles", "9999", "--blocks", "2"], "--blocks 2: 2 blocks of 5041 particles, 0.507 wide"),
        (["goop", "--gravity", "down"], "--gravity down"),
        (["goop", "--gravity", "0,-5"], "but the model knows only [0.0, -9.81]"),
        (["wbcsph", "--gravity", "0,-50", "--particles", "50"], "outside of the range that the model was calibrated"),
        (["goop", "--data", "nowhere.h5"], "--data nowhere.h5: there is no such file."),
        (["goop", "--data", "."], "--data .: it is a folder; name a file in it"),
        (["goop", "--out", "no/where.h5"], "--out no/where.h5: the folder no does not exist"),
        (["goop", "--out", "."], "--out .: it is a folder"),
        (["goop", "--device", "cuda:77"], "has no device 'cuda:77'"),
        (["goop", "--device", "gpu"], "--device gpu: it is not one of auto, cpu, cuda, mps"),
        (["goop", "--device", "meta"], "--device meta: it is not one of"),
        (["goop", "--runtime", "fast"], "called 'fast'; there are auto, cuda-graph, triton, openvino, eager."),
        (["goop", "--runtime", "cuda-graph"], "The runtime cuda-graph needs a CUDA GPU; the model is on cpu."),
        (["gop"], "Did you mean goop?"),
        (["nothing.ckpt"], "nothing.ckpt: there is no such checkpoint"),
        (["."], "holds no model"),
        (["goop", "--root", "nowhere"], "There is no zoo in nowhere"),
    ],
)
def test_wrong_calls_get_one_line(words, message, folder, capsys):
    assert main(["rollout", *words]) == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not list(folder.glob("*.h5"))


def test_the_gravity_of_a_rollout_is_written_beside_it(folder, capsys):
    few = ["rollout", "wbcsph", "--frames", "2", "--particles", "50"]
    assert main(few) == 0
    np.testing.assert_allclose(Split(folder / "out.h5").read(0).attributes["gravity"], [0, -9.81], rtol=1e-3)
    assert main([*few, "--gravity", "6,7.5"]) == 0
    np.testing.assert_allclose(Split(folder / "out.h5").read(0).attributes["gravity"], [6, 7.5], rtol=1e-6)
    assert read_labelled(Split(folder / "out.h5")).gravity == pytest.approx((6, 7.5))
    assert main([*few, "--gravity", "6,7.5", "--data", "out.h5"]) == 1
    assert "--gravity is of thrown blocks" in capsys.readouterr().err


def test_as_many_frames_are_written_and_named_as_were_asked_for(folder, capsys):
    assert main(["rollout", "goop", "--frames", "20", "--particles", "50"]) == 0
    assert Split(folder / "out.h5").frames(0) == 22
    said = capsys.readouterr().out
    assert "20 frames; most" in said
    assert "24" not in said.partition("wrote")[0].partition("most")[0]


@pytest.mark.parametrize(("asked", "predicted", "compared"), [(None, 30, 30), (12, 12, 12), (40, 40, 30)])
def test_a_recording_is_predicted_to_its_end_and_stored_beside(asked, predicted, compared, make_dataset, capsys):
    file = make_dataset(test=((32, 5), (32, 9)), statics=0) / "test.h5"
    frames = [] if asked is None else ["--frames", str(asked)]
    assert main(["rollout", "goop", "--data", str(file), "--trajectory", "1", *frames]) == 0
    said = capsys.readouterr().out
    assert f"2 frames of the start and {predicted} predicted, of 9 particles" in said
    assert f"trajectory 1, {compared} frames: error ×10⁻³" in " ".join(said.split())
    assert "nothing moves" in said
    shown = read_labelled(Split(Path("out.h5")))
    assert list(shown.positions) == ["truth", "prediction"]
    recorded = Split(file).read(1).position
    np.testing.assert_array_equal(shown.positions["truth"], recorded[: compared + 2])
    np.testing.assert_allclose(shown.positions["prediction"][:2], recorded[:2], atol=1e-7)
    assert Split(Path("out.h5")).frames(0) == predicted + 2
    assert main(["view", "out.h5", str(file), "--truth-trajectory", "1"]) == 0


def test_a_truth_of_other_particles_is_refused(folder):
    trajectory = made_up_trajectory(6, 5)
    attributes = {"scene": SCENE, "particle_types": '{"7": "goop"}', "static_types": np.array([3])}
    written = Trajectory(trajectory.position, trajectory.particle_type, attributes, {"truth": np.zeros((6, 4, 2))})
    write_split(folder / "out.h5", [written])
    with pytest.raises(DataError, match=r"out.h5, trajectory 00000: truth has the shape \(6, 4, 2\)"):
        read_labelled(Split(folder / "out.h5"))


WRITERS = [
    ["rollout", "goop", "--out", "a.h5"],
    ["export", "goop", "--out", "a.onnx"],
    ["simulate", "goop", "--out", "new"],
    ["simulate", "goop", "--preview", "a.png"],
    ["inspect", ".", "--out", "a.png"],
]


@pytest.mark.parametrize("words", WRITERS, ids=lambda words: " ".join(words))
def test_a_read_only_folder_is_found_before_the_work(words, folder, monkeypatch, capsys):
    def fail(**_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(tempfile, "TemporaryFile", fail)
    assert main(words) == 1
    assert "is not writable (Read-only file system)" in capsys.readouterr().err


LONG = "x" * 300


@pytest.mark.parametrize(
    "words",
    [
        ["rollout", "goop", "--out", LONG + ".h5"],
        ["rollout", "goop", "--out", f"{LONG}/a.h5"],
        ["rollout", "goop", "--data", LONG],
        ["export", "goop", "--out", LONG + ".onnx"],
        ["simulate", "goop", "--out", LONG],
        ["simulate", "goop", "--preview", LONG + ".png"],
        ["simulate", LONG],
        ["inspect", LONG],
        ["inspect", ".", "--out", LONG + ".png"],
        ["convert", LONG, "new"],
        ["convert", ".", LONG],
        ["render", LONG],
        ["stress", "goop", "--report", LONG],
        ["fit", "--config", LONG],
        ["fit", "--config", "goop.yaml", "--data.path", LONG],
        ["fit", "--config", "goop.yaml", "--ckpt_path", LONG],
        ["fit", "--config", "goop.yaml", "--trainer.default_root_dir", LONG],
    ],
    ids=lambda words: " ".join(words).replace(LONG, "x…"),
)
def test_names_that_are_too_long_for_the_file_system_get_one_line_before_the_work(words, folder, capsys):
    assert main(words) == 1
    said = capsys.readouterr()
    assert re.search(r"[Nn]ame (is )?too long", said.err)
    assert said.err.count("\n") == 1
    assert said.out == ""
    assert not list(folder.iterdir())


def test_a_name_that_just_fits_is_written(tmp_path):
    path = tmp_path / ("x" * 250 + ".h5")
    assert file_obstacle(path) == ""
    with atomic_write(path) as part:
        part.write_text("written")
    assert path.read_text() == "written"
    assert "too long" in file_obstacle(tmp_path / ("x" * 253 + ".h5"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["simulate", "goop", "--preview", "a.gif"], "--preview a.gif: pictures are PNG"),
        (["simulate", "goop", "--seed", "-1"], "--seed -1: it must be at least 0."),
        (["simulate", "goop", "--out", "file"], "--out file: it is a file; name a folder."),
        (["simulate", "goop", "--out", "file/new"], "is a file, not a folder"),
        (["convert", ".", "file"], "DESTINATION file: it is a file; name a folder."),
        (["convert", ".", "file/new"], "is a file, not a folder"),
        (["rollout", "goop", "--out", "file/a.h5"], "--out file/a.h5: file is a file, not a folder."),
        (["fit", "--config", "goop.yaml", "--trainer.default_root_dir", "file"], "default_root_dir file: it is a file"),
        (["fit", "--config", "goop.yaml", "--trainer.default_root_dir", "file/a"], "is a file, not a folder"),
        (["inspect", "nowhere"], "nowhere: there is no such file or folder."),
        (["inspect", ".", "--out", "no/a.png"], "--out no/a.png: the folder no does not exist"),
        (["render", "nowhere.h5"], "FILE nowhere.h5: there is no such file."),
        (["export", "goop", "--out", "no/a.onnx"], "--out no/a.onnx: the folder no does not exist"),
        (["export", "gop"], "Did you mean goop?"),
        (["export", "."], "holds no model"),
    ],
)
def test_wrong_calls_of_other_commands(words, message, folder, capsys):
    (folder / "file").touch()
    assert main(words) == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
