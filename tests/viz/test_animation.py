import dataclasses
import importlib.util

import numpy as np
import pytest
from PIL import Image, ImageSequence

from nmpm._support.atomic import replacing
from nmpm.errors import ConfigError
from nmpm.viz import animation
from nmpm.viz.colours import INTERIOR, PAGE, WALL, colour
from nmpm.viz.gif_palette import GROUND, SIZE, GifPalette, _cell
from nmpm.viz.progress import tracked
from nmpm.viz.reel import Reel


def frames_of(path):
    with Image.open(path) as file:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(file)]


def test_every_frame_is_in_the_gif(falling, tmp_path):
    frames = frames_of(animation(falling, tmp_path / "a.gif", side=100))
    assert len(frames) == falling.frames
    assert [file.name for file in tmp_path.iterdir()] == ["a.gif"]


def test_frames_are_thinned_to_the_number_asked_for(falling, tmp_path):
    assert len(frames_of(animation(falling, tmp_path / "a.gif", side=100, max_frames=4))) == 4


def test_frames_at_rest_are_kept(falling, tmp_path):
    rest = dataclasses.replace(falling, rows={"simulation": np.repeat(falling.rows["simulation"][:1], 6, axis=0)})
    assert len(frames_of(animation(rest, tmp_path / "rest.gif", side=100))) == 6


def test_the_gif_shows_what_the_reel_draws(falling, tmp_path):
    """Nothing is left over from earlier frames, and colours are close to those drawn."""
    reel = Reel(falling, 160)
    for frame, shown in enumerate(frames_of(animation(falling, tmp_path / "a.gif", side=160))):
        drawn = reel.draw(frame)
        assert shown.shape == drawn.shape
        difference = np.abs(shown.astype(int) - drawn)
        assert difference.mean() < 1
        assert np.quantile(difference, 0.999) < 40


def test_truth_left_prediction_right(falling):
    image = Reel(falling, 160).draw(5)
    water = np.abs(image.astype(int) - colour("water")).max(axis=2) < 5
    water[-30:] = False
    columns = np.flatnonzero(water.any(axis=0))
    assert columns.min() < image.shape[1] // 2 < columns.max()


def test_wide_boxes_are_stacked(falling):
    wide = dataclasses.replace(falling, bounds=((0, 4), (0, 1)), domain=None)
    one = dataclasses.replace(wide, rows={"simulation": wide.rows["simulation"]})
    assert Reel(wide, 160).width == Reel(one, 160).width
    assert Reel(wide, 160).height > Reel(one, 160).height


def test_frames_differ_where_particles_move(falling):
    reel = Reel(falling, 160)
    middle = slice(60, reel.height - 40)
    assert (reel.draw(0)[middle] != reel.draw(1)[middle]).any()


def test_time_passes_as_fast_as_asked(falling, tmp_path):
    with Image.open(animation(falling, tmp_path / "a.gif", side=100, fps=25, max_frames=3)) as file:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(file)]
    assert durations == [40, 40, 1000]


def test_a_single_frame_makes_a_gif(still, tmp_path):
    assert len(frames_of(animation(still([[0.5, 0.5]], ["water"]), tmp_path / "one.gif", side=100))) == 1


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="imageio-ffmpeg is not installed")
def test_mp4(falling, tmp_path):
    import imageio.v3 as imageio

    path = animation(falling, tmp_path / "a.mp4", side=100)
    video = imageio.imread(path, plugin="FFMPEG")
    reel = Reel(falling, 100)
    assert video.shape == (falling.frames, reel.height, reel.width, 3)


def test_mp4_without_its_encoder_says_what_to_install(falling, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'nmpm\[video\]'.*\.gif"):
        animation(falling, tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.avi", "a"])
def test_an_unknown_suffix_lists_the_known(falling, tmp_path, name):
    with pytest.raises(ConfigError, match=r"\.gif or \.mp4"):
        animation(falling, tmp_path / name)


@pytest.mark.parametrize("setting", [{"fps": 0}, {"fps": 1000}, {"fps": float("nan")}, {"max_frames": 0}, {"side": 3}])
def test_settings_out_of_range_are_named(falling, tmp_path, setting):
    with pytest.raises(ConfigError, match=next(iter(setting))):
        animation(falling, tmp_path / "a.gif", **setting)


def test_the_palette_keeps_grounds_and_rare_materials_exact():
    frame = np.full((40, 40, 3), PAGE, dtype=np.uint8)
    frame[:20] = INTERIOR
    frame[:3] = WALL
    frame[30, 30] = colour("goop")
    shown = np.asarray(GifPalette([frame], [colour("goop")]).apply(frame).convert("RGB"))
    np.testing.assert_array_equal(shown, frame)


def test_grounds_do_not_share_a_cell_of_the_look_up_table():
    assert len({int(_cell(np.array(ground, dtype=np.uint8))) for ground in GROUND}) == len(GROUND)


def test_the_transparent_entry_is_free():
    noise = np.random.default_rng(0).integers(0, 256, (100, 100, 3), dtype=np.uint8)
    assert np.asarray(GifPalette([noise]).apply(noise)).max() < SIZE - 1


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.gif"
    path.write_text("old")

    def fail():
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_progress_gives_every_item_and_stays_silent(capsys):
    assert list(tracked(iter("abc"), 3, "Drawing")) == ["a", "b", "c"]
    captured = capsys.readouterr()
    assert not captured.out
    assert not captured.err
