"""Mistakes of a first hour: a message of one line that names what is wrong, and how to mend it."""

import numpy as np
import pytest

from nmpm.cli import main
from nmpm.data.format import Trajectory, write_split


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "mend"),
    [
        (["fit", "--config", "gop.yaml"], "Did you mean goop.yaml"),
        (["simulate", "waterramp", "--out", "a"], "Did you mean waterramps"),
        (["compare", "goop", "--data", "gop"], "Did you mean goop"),
        (["trade", "sandramp"], "Did you mean sandramps"),
        (["test", "--config", "goop.yaml", "--ckpt_path", "best"], "To start a new run, call nmpm fit without"),
    ],
)
def test_near_names_and_next_steps_are_named(words, mend, folder, capsys):
    assert main(words) == 1
    said = capsys.readouterr().err
    assert mend in said
    assert said.count("\n") == 1
    assert not list(folder.iterdir())


def test_a_scene_that_is_not_yaml_is_named_in_one_line(folder, capsys):
    (folder / "scene.yaml").write_text("a: [\n")
    assert main(["simulate", "scene.yaml"]) == 1
    said = capsys.readouterr().err
    assert "Preset scene.yaml cannot be read: while parsing" in said
    assert said.count("\n") == 1


def test_inspect_refuses_a_rollout_and_says_how_to_look_at_it(folder, capsys):
    write_split(folder / "out.h5", [Trajectory(np.zeros((3, 4, 2), np.float32), np.zeros(4, np.int64))])
    assert main(["inspect", "out.h5"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("nmpm inspect: out.h5: ")
    assert "nmpm view out.h5" in said


def test_inspect_names_a_file_that_is_not_hdf5(folder, capsys):
    (folder / "text.h5").write_text("hello")
    assert main(["inspect", "text.h5"]) == 1
    assert "text.h5: cannot be read as HDF5" in capsys.readouterr().err
