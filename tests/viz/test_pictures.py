"""Snapshots and animations as files, and `nmpm render`, which writes both."""

import dataclasses
import importlib.util
import json
import resource
import sys
from pathlib import Path

import imageio.v3 as imageio
import matplotlib as mpl
import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from nmpm.cli import main
from nmpm.colours import BACKGROUND, INTERIOR, WALL, material_colours
from nmpm.data.format import Split, Trajectory, write_split
from nmpm.errors import ConfigError, DataError
from nmpm.evaluation.pictures import labelled_trajectories
from nmpm.particles import Window
from nmpm.scene import Scene
from nmpm.viz import write_animation, write_snapshots
from nmpm.viz.animation import FrameRenderer, GifPalette
from nmpm.viz.panel import PanelRenderer

needs_ffmpeg = pytest.mark.skipif(
    importlib.util.find_spec("imageio_ffmpeg") is None, reason="imageio-ffmpeg is not installed"
)
FORMATS = [
    pytest.param(write_snapshots, "a.png", id="png"),
    pytest.param(write_animation, "a.gif", id="gif"),
    pytest.param(write_animation, "a.mp4", id="mp4", marks=[needs_ffmpeg, pytest.mark.slow]),
]
WATER = material_colours(["water"])["water"]


def pixels(path):
    return np.asarray(Image.open(path).convert("RGB"))


def frames_of(path):
    with Image.open(path) as file:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(file)]


def water_in(image, top, bottom=0):
    """Rows and columns of pixels in water's colour, without titles, legends and footers."""
    water = np.abs(image.astype(int) - WATER).max(axis=2) <= 6
    water[:top] = False
    water[len(water) - bottom :] = False
    return np.nonzero(water)


def test_the_size_of_snapshots_follows_from_columns_and_rows(falling, tmp_path):
    settings = dict(mpl.rcParams)
    one = pixels(write_snapshots(falling, tmp_path / "1.png", columns=1))
    three = pixels(write_snapshots(falling, tmp_path / "3.png", columns=3))
    alone = dataclasses.replace(falling, positions={"simulation": falling.positions["simulation"]})
    one_row = pixels(write_snapshots(alone, tmp_path / "row.png", columns=3))
    assert three.shape[0] == one.shape[0] > one_row.shape[0] + 330
    assert three.shape[1] - one.shape[1] == 2 * (330 + 12)
    assert one_row.shape[1] == three.shape[1]
    assert dict(mpl.rcParams) == settings
    assert sorted(file.name for file in tmp_path.iterdir()) == ["1.png", "3.png", "row.png"]


def test_the_chart_of_errors_is_in_the_length_of_the_data_whatever_it_is(falling, tmp_path):
    text = write_snapshots(falling, tmp_path / "a.svg", columns=2).read_text(encoding="utf-8")
    assert "RMS position error (length)" in text


def test_snapshots_run_from_left_to_right_with_the_prediction_below(falling, tmp_path):
    rows, columns = water_in(image := pixels(write_snapshots(falling, tmp_path / "a.png", columns=2)), top=110)
    first = columns < image.shape[1] // 2
    assert rows[first].min() + 150 < rows[~first].min()
    rows = np.unique(water_in(pixels(write_snapshots(falling, tmp_path / "a.png", columns=1)), top=110)[0])
    (gap,) = np.flatnonzero(np.diff(rows) > 1)
    assert rows[gap + 1] - rows[0] == 330 + 12


def test_the_gif_shows_the_drawn_frames(falling, tmp_path):
    """No pixels remain from earlier frames, and colours are close to those drawn."""
    renderer = FrameRenderer(falling, 160)
    path = write_animation(falling, tmp_path / "a.gif", side=160, fps=25)
    with Image.open(path) as file:
        assert [frame.info["duration"] for frame in ImageSequence.Iterator(file)] == [40] * 10 + [1000]
    shown = frames_of(path)
    assert len(shown) == falling.frame_count
    for frame, image in enumerate(shown):
        drawn = renderer.draw(frame)
        difference = np.abs(image.astype(int) - drawn)
        assert difference.mean() < 1
        assert np.quantile(difference, 0.999) < 40
    _, columns = water_in(renderer.draw(5), top=0, bottom=30)
    assert columns.min() < renderer.width // 2 < columns.max()  # truth is left and prediction right
    assert (renderer.draw(0) != renderer.draw(1))[60 : renderer.height - 40].any()


@needs_ffmpeg
def test_the_mp4_has_all_frames(falling, tmp_path):
    video = imageio.imread(write_animation(falling, tmp_path / "a.mp4", side=100), plugin="FFMPEG")
    renderer = FrameRenderer(falling, 100)
    assert video.shape == (falling.frame_count, renderer.height, renderer.width, 3)


def test_the_palette_keeps_fixed_colours_and_rare_materials_exact():
    frame = np.full((40, 40, 3), BACKGROUND, dtype=np.uint8)
    frame[:20], frame[:3], frame[30, 30] = INTERIOR, WALL, WATER
    shown = np.asarray(GifPalette([frame], [WATER]).quantize(frame).convert("RGB"))
    np.testing.assert_array_equal(shown, frame)


@pytest.mark.parametrize(
    ("write", "name", "options", "message"),
    [
        (write_animation, "a.avi", {}, r"\.gif or \.mp4"),
        (write_animation, "a.gif", {"fps": float("nan")}, "fps"),
        (write_animation, "a.gif", {"side": 3}, "side"),
        (write_snapshots, "a.png", {"columns": 0}, "columns = 0"),
    ],
)
def test_wrong_arguments_are_named(falling, tmp_path, write, name, options, message):
    with pytest.raises(ConfigError, match=message):
        write(falling, tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("write", "name"), FORMATS)
def test_an_unusable_path_is_reported_before_drawing(falling, tmp_path, monkeypatch, write, name):
    monkeypatch.setattr(PanelRenderer, "__init__", lambda *_: pytest.fail("drawing started before the check"))
    (tmp_path / name).mkdir()
    with pytest.raises(DataError, match="is a folder"):
        write(falling, tmp_path / name)


@pytest.mark.parametrize(("write", "name"), FORMATS)
def test_a_full_disk_or_an_interruption_keeps_the_old_file(falling, tmp_path, monkeypatch, write, name):
    """A limit on the file size stands for the full disk; it also holds for the encoder's process."""
    (tmp_path / name).write_text("old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        with pytest.raises(DataError, match=rf"Cannot write \S*{name}: [^\n]*$"):
            write(falling, tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    draw, calls = PanelRenderer.draw, iter(range(1000))

    def draw_some(self, *positions):
        if next(calls) == 9:
            raise KeyboardInterrupt
        return draw(self, *positions)

    monkeypatch.setattr(PanelRenderer, "draw", draw_some)
    with pytest.raises(KeyboardInterrupt):
        write(falling, tmp_path / name)
    assert (tmp_path / name).read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == [name]


@needs_ffmpeg
def test_a_failing_encoder_is_reported(falling, tmp_path, monkeypatch):
    """The encoder reads everything, then fails without closing the video: imageio does not report it."""
    encoder = tmp_path / "encoder.py"
    lines = "import sys", "open(sys.argv[-1], 'wb').write(b'half')", "sys.stdin.buffer.read()", "sys.exit(1)"
    encoder.write_text("\n".join((f"#!{sys.executable}", *lines)))
    encoder.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(encoder))
    monkeypatch.chdir(tmp_path)  # counting frames, it is told to write to "-"
    with pytest.raises(DataError, match="video encoder"):
        write_animation(falling, tmp_path / "a.mp4")
    assert not (tmp_path / "a.mp4").exists()


def test_a_non_finite_frame_ends_the_drawing_with_a_title(falling):
    scene = Scene(falling.bounds, falling.domain, falling.dt, materials=("water", "sand"), particle_volume=1e-4)
    truth = torch.tensor(falling.positions["simulation"]).float()[None]
    none = torch.zeros(1, 0, 2)
    window = Window(
        truth,
        material=torch.tensor([[0, 1]]),
        mask=torch.ones(1, 2, dtype=torch.bool),
        obstacle=none,
        obstacle_mask=none[..., 0].bool(),
        gravity=torch.zeros(1, 2),
    )
    predicted = truth[:, 2:].clone()
    predicted[0, 4:, 1, 0] = float("nan")
    trajectories = labelled_trajectories(scene, window, predicted)
    assert trajectories.frame_count == 6
    assert trajectories.title == "The prediction is not finite from frame 6 on"
    assert labelled_trajectories(scene, window, truth[:, 2:]).title == ""


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


@pytest.mark.usefixtures("rollout")
@pytest.mark.parametrize(
    ("words", "stem", "suffix"),
    [
        ([], "out", ".gif"),
        pytest.param(["--mp4", "--out", "v1.5"], "v1.5", ".mp4", marks=[needs_ffmpeg, pytest.mark.slow]),
    ],
)
def test_render_writes_snapshots_and_an_animation(words, stem, suffix, capsys):
    assert main(["render", "out.h5", *words]) == 0
    assert capsys.readouterr().out == f"wrote {stem}.png\nwrote {stem}{suffix}\n"
    assert {path.name for path in Path().iterdir()} == {"out.h5", f"{stem}.png", f"{stem}{suffix}"}


@pytest.mark.usefixtures("rollout")
def test_render_draws_a_truth_of_another_file_beside_it(monkeypatch, capsys):
    run = Split(Path("out.h5")).read(0)
    write_split(Path("truth.h5"), [run, dataclasses.replace(run, position=run.position + 0.2)])
    drawn = []
    monkeypatch.setattr("nmpm.viz.write_animation", lambda shown, path: drawn.append(shown) or path)
    assert main(["render", "out.h5", "truth.h5"]) == 0
    assert list(drawn[0].positions) == ["truth.h5", "out.h5"]
    assert main(["render", "out.h5", "truth.h5", "--truth-trajectory", "1"]) == 1
    assert "do not start at the same positions" in capsys.readouterr().err
    assert main(["render", "out.h5", "none.h5"]) == 1
    assert "TRUTH none.h5: there is no such file" in capsys.readouterr().err


@pytest.mark.usefixtures("rollout")
@pytest.mark.parametrize(("style", "file", "start"), [("talk", "out.svg", b"<?xml"), ("paper", "out.pdf", b"%PDF")])
def test_render_writes_snapshots_for_slides_and_print(style, file, start):
    assert main(["render", "out.h5", "--style", style]) == 0
    assert Path(file).read_bytes().startswith(start)
    assert {path.name for path in Path().iterdir()} == {"out.h5", file, "out.gif"}


@pytest.mark.usefixtures("rollout")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "missing/a"], "the folder missing does not exist"),
        (["--mp4"], 'pip install -e ".[video]"'),
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
