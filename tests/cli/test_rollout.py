import re
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from nmpm import Zoo, load_trajectories
from nmpm._support.shipped import shipped_folder
from nmpm.cli import main
from nmpm.data import catalog
from nmpm.data.convert import open_dataset
from nmpm.data.format import Split, read_metadata
from nmpm.data.simulation import generate
from nmpm.emulator.trust import Trust
from nmpm.sim import load_preset
from nmpm.viz.files import read_labelled
from nmpm.zoo.pretrained import Pretrained


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    return tmp_path


def test_names_and_paths_give_the_same_rollout(folder, capsys):
    (folder / "copy").symlink_to(shipped_folder("zoo") / "goop")
    few = ["--frames", "20", "--particles", "50"]
    assert main(["rollout", "goop", *few, "--out", "a.h5"]) == 0
    assert "20 frames. At most: speed" in capsys.readouterr().out
    assert main(["rollout", "./copy", *few, "--out", "b.h5"]) == 0
    assert main(["rollout", "goop", "--root", str(shipped_folder("zoo")), *few, "--out", "c.h5"]) == 0
    a, b, c = (Split(folder / f"{name}.h5").read(0).position for name in "abc")
    assert a.shape[0] == 22
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(a, c)


def test_a_rollout_is_of_the_scene_of_its_model_unless_blocks_are_asked_for(folder, capsys):
    """Waterramps came without ramps, and with another number of particles than its own."""
    state = Zoo.load("waterramps").example(seed=2)
    assert main(["rollout", "waterramps", "--frames", "9", "--seed", "2"]) == 0
    said = capsys.readouterr().out
    assert f"Scene of waterramps, seed 2: {state.position.shape[1]:,} particles, with obstacles." in said
    assert re.search(r"[\d.]+ ms per frame on .* threads?\.", said)
    written = Split(folder / "out.h5").read(0)
    np.testing.assert_allclose(written.position[1], np.concatenate([state.position[0], state.obstacle[0]]), atol=1e-6)
    assert main(["rollout", "waterramps", "--frames", "2", "--blocks", "2"]) == 0
    assert "Scene of" not in capsys.readouterr().out
    assert Split(folder / "out.h5").particles(0) == 968
    assert main(["rollout", "waterdrop", "--frames", "2"]) == 0
    assert "No preset has the scenes that waterdrop was trained on: about 1,000 particles" in capsys.readouterr().out


def test_a_rollout_takes_the_name_of_a_dataset_and_stores_the_truth_beside(folder, monkeypatch, capsys):
    asked = []
    made = make_goop(folder / "made")
    monkeypatch.setattr(catalog, "ensure", lambda name, counts: asked.append((name, counts)) or made)
    assert main(["rollout", "goop", "--data", "goop", "--trajectory", "1", "--frames", "2"]) == 0
    assert asked == [("goop", {"train": 0, "valid": 0, "test": 2})]
    assert "beside the recording, to out.h5" in capsys.readouterr().out
    assert list(read_labelled(Split(folder / "out.h5")).positions) == ["truth", "prediction"]
    assert main(["rollout", "goop", "--data", "gop"]) == 1
    assert "nor an embedded dataset of that name: dambreak2d, goop" in capsys.readouterr().err


def make_goop(path):
    generate(load_preset("goop").with_frames(4), path, {"train": 0, "valid": 0, "test": 2}, 0, 1)
    return path


def test_another_runtime_gives_the_same_rollout_to_rounding(folder):
    if find_spec("openvino") is None:  # importing it would report to its makers
        pytest.skip("openvino is not installed")
    few = ["rollout", "goop", "--frames", "8", "--particles", "50"]
    for name in ("eager", "openvino"):
        assert main([*few, "--runtime", name, "--out", f"{name}.h5"]) == 0
    one, other = (Split(folder / f"{name}.h5").read(0).position for name in ("eager", "openvino"))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-4)


def test_the_gravity_of_a_rollout_is_written_beside_it(folder, capsys):
    assert main(["rollout", "wbcsph", "--frames", "2", "--particles", "50", "--gravity", "6,7.5"]) == 0
    assert read_labelled(Split(folder / "out.h5")).gravity == pytest.approx((6, 7.5))
    assert main(["rollout", "wbcsph", "--gravity", "6,-7.5", "--data", "out.h5"]) == 1
    assert "contradicts" in capsys.readouterr().err


@pytest.mark.parametrize(("asked", "predicted", "compared"), [(None, 30, 30), (12, 12, 12), (40, 40, 30)])
def test_a_recording_is_predicted_to_its_end_and_stored_beside(asked, predicted, compared, make_dataset, capsys):
    file = make_dataset(test=((32, 5), (32, 9))) / "test.h5"
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


def test_a_rollout_starts_from_data_of_any_form(make_dataset, capsys):
    """Whose tests are taken unless a split is named; pictures and pages show such data, too."""
    folder = make_dataset(train=((12, 5),), test=((12, 9),))
    runs = {name: Split(folder / f"{name}.h5").read(0) for name in ("train", "test")}
    Path("runs").mkdir()
    for name, run in runs.items():
        np.savez(f"runs/{name}.npz", position=run.position, types=run.particle_type)
    names = ",".join(f"{i}={name}" for i, name in read_metadata(folder).particle_types.items())
    assert main(["convert", "runs", "copy", "--types", names]) == 0
    for data, split, expected in (("copy", [], "test"), ("copy", ["--split", "train"], "train"), (folder, [], "test")):
        assert main(["rollout", "goop", "--data", str(data), *split, "--frames", "4"]) == 0
        np.testing.assert_allclose(Split(Path("out.h5")).read(0).position[:2], runs[expected].position[:2], atol=1e-7)
    assert main(["rollout", "goop", "--data", "copy", "--split", "valid"]) == 1
    assert "--split valid: copy has train, test." in capsys.readouterr().err
    assert main(["view", "runs/test.npz"]) == 0 == main(["render", "runs", "--split", "train"])
    assert Path("runs/test.html").exists()
    assert Path("runs.gif").exists()


def test_members_become_a_trajectory_each_that_is_read_back(folder, make_dataset, capsys):
    data = make_dataset(test=((22, 9),))
    assert main(["rollout", "goop", "--data", str(data), "--members", "3", "--seed", "5"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "wrote 3 members of 2 frames of the start and 20 predicted, of 9 particles, to out.h5" in said
    assert "ms per frame and member" in said
    assert "a member, mean of 3" in said
    assert "without noise and nudge" in said
    members = load_trajectories("out.h5").test
    assert [int(one.attributes["member"]) for one in members] == [0, 1, 2]
    model, recorded = Zoo.load("goop"), Split(data / "test.h5").read(0)
    state = model.start(load_trajectories(data).test[0])
    expected = model.rollout(state, 20, members=3, seed=5)[:, 0]
    for member, position in zip(members, expected, strict=True):
        np.testing.assert_allclose(member.position[2:], position, atol=1e-6)
        assert 0 < np.abs(member.position[1] - recorded.position[1]).max() < 0.02
    np.testing.assert_array_equal(Split(folder / "out.h5").fields(2)["truth"], recorded.position)
    assert main(["view", "out.h5"]) == 0


def test_members_become_files_of_their_own_where_a_form_holds_one_trajectory(folder, capsys):
    few = ["rollout", "goop", "--members", "2", "--frames", "3", "--particles", "20", "--nudge", "0"]
    Path("new").mkdir()
    assert main([*few, "--out", "new/out.csv"]) == 0
    assert "to new/out-0.csv … new/out-1.csv" in capsys.readouterr().out
    assert Path("new/out-0.csv").read_text() == Path("new/out-1.csv").read_text()
    assert sorted(path.name for path in Path("new").iterdir()) == ["out-0.csv", "out-1.csv"]
    Path("out-1.csv").mkdir()
    assert main([*few, "--out", "out.csv"]) == 1
    assert "--out out-1.csv: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--members", "0"], "--members 0: it must be at least 1"),
        (["--members", "2", "--nudge", "-1"], "--nudge -1.0: it must be a number of cells"),
        (["--nudge", "0.1"], "give --members too"),
        (["--members", "2", "--seed", "-1"], "--seed -1"),
    ],
)
def test_wrong_members_are_refused_in_one_line(options, message, capsys):
    assert main(["rollout", "goop", *options]) == 1
    assert message in capsys.readouterr().err


def test_a_rollout_ends_with_the_last_trusted_frame(folder, monkeypatch, capsys):
    few = ["rollout", "goop", "--frames", "24", "--particles", "100"]
    assert main([*few, "--out", "full.h5"]) == 0 == main([*few, "--until", "trusted", "--out", "all.h5"])
    assert "Trusted for all 24 frames" in capsys.readouterr().out
    monkeypatch.setattr(Pretrained, "trust", Trust(limit=0.02, error=0.25, scenes=8))
    assert main([*few, "--until", "trusted", "--out", "some.h5"]) == 0
    said = capsys.readouterr().out
    full, whole, some = (Split(folder / f"{name}.h5").read(0).position for name in ("full", "all", "some"))
    last = len(some) - 2
    assert f"Beyond frame {last} ± {round(0.25 * last)} this scene is one of many." in said
    assert 0 < last < 24
    np.testing.assert_array_equal(whole, full)
    np.testing.assert_array_equal(some, full[: len(some)])
    monkeypatch.setattr(Pretrained, "trust", Trust(limit=1e-9))
    for words, message in (
        ([*few, "--until", "trusted"], "--until trusted: no frame is."),
        ([*few, "--until", "trusted", "--members", "2"], "leave --members out"),
    ):
        assert main(words) == 1
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("members", [[], ["--members", "2"]])
def test_a_rollout_keeps_the_ids_and_types_of_its_recording(folder, members):
    """Those of a table whose rows are in any order, with particles that come late, in every form that has ids."""
    run = Split(make_goop(folder / "made") / "test.h5").read(0)
    rng, count = np.random.default_rng(0), run.position.shape[1]
    ids, types = 7 + rng.permutation(3 * count)[:count], rng.integers(4, 6, count)
    late = rng.random(count) < 0.1
    rows = [
        f"{frame},{ids[i]},{'slime' if types[i] == 5 else 'goop'},{x!r},{y!r}"
        for frame, positions in enumerate(run.position.tolist())
        for i, (x, y) in enumerate(positions)
        if frame > 1 or not late[i]
    ]
    (folder / "mine.csv").write_text("\n".join(["frame,id,type,x,y", *rng.permutation(rows).tolist()]) + "\n")
    facts = ["--bounds", "0.1:0.9,0.1:0.9", "--gravity", "0,-9.81", "--materials", "slime=goop", "--frames", "2"]
    for suffix in (".h5", ".csv") if members else (".h5", ".npz", ".csv", ".lammpstrj", ".vtkhdf"):
        words = ["rollout", "goop", "--data", "mine.csv", *facts, *members, "--out", f"out{suffix}"]
        assert main(words) == 0
        name = f"out-0{suffix}" if members and suffix == ".csv" else f"out{suffix}"
        predicted = open_dataset(folder / name)
        written = next(next(iter(predicted.splits.values()))())
        here = np.flatnonzero(~np.isnan(written.position[0, :, 0]))
        column = {number: index for index, number in enumerate(ids.tolist())}
        source = np.array([column[number] for number in written.ids()[0, here].tolist()])
        assert not late[source].any()
        np.testing.assert_allclose(written.position[0, here], run.position[0, source], atol=0.02 if members else 1e-6)
        names = predicted.metadata.particle_types
        if suffix in (".h5", ".npz", ".vtkhdf"):  # the others have numbers
            assert [names[n] for n in written.particle_type[here]] == [("goop", "slime")[t - 4] for t in types[source]]
