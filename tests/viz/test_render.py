import json
import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from PIL import Image

from nmpm.cli import main
from nmpm.data.format import Split, Trajectory, write_split
from nmpm.scene import Scene


@pytest.fixture
def rollout(falling, tmp_path, monkeypatch):
    """A file as `nmpm rollout` writes it; the working directory contains nothing else."""
    scene = Scene(falling.bounds, falling.domain, dt=falling.dt, materials=("water", "sand"), particle_volume=1e-4)
    attributes = {
        "generator": "predicted by a test",
        "scene": json.dumps(scene.to_dict()),
        "particle_types": json.dumps({5: "water", 6: "sand"}),
        "static_types": np.zeros(0, dtype=np.int64),
    }
    monkeypatch.chdir(tmp_path)
    write_split(Path("out.h5"), [Trajectory(falling.positions["prediction"], np.array([5, 6]), attributes)])
    return falling


def test_render_writes_png_and_gif(rollout, capsys):
    assert main(["render", "out.h5"]) == 0
    assert capsys.readouterr().out == "wrote out.png\nwrote out.gif\n"
    assert sorted(path.name for path in Path().iterdir()) == ["out.gif", "out.h5", "out.png"]
    with Image.open("out.gif") as animation:
        assert animation.n_frames == rollout.frame_count


def test_render_writes_mp4_instead_of_gif(rollout, capsys):
    pytest.importorskip("imageio_ffmpeg")
    assert main(["render", "out.h5", "--mp4", "--out", "v1.5"]) == 0
    assert capsys.readouterr().out == "wrote v1.5.png\nwrote v1.5.mp4\n"
    assert len(imageio.imread("v1.5.mp4", plugin="FFMPEG")) == rollout.frame_count
    assert sorted(path.name for path in Path().iterdir()) == ["out.h5", "v1.5.mp4", "v1.5.png"]


@pytest.mark.usefixtures("rollout")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "missing/a"], "the folder missing does not exist"),
        (["--mp4"], "pip install nmpm[video]"),
        (["--trajectory", "1"], "trajectories 0 … 0"),
    ],
)
def test_mistakes_are_one_line_before_the_trajectory_is_read(words, message, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr(Split, "read", lambda *_: pytest.fail("the trajectory was read before the checks"))
    assert main(["render", "out.h5", *words]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert [path.name for path in Path().iterdir()] == ["out.h5"]
