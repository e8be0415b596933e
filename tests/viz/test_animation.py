import dataclasses
import importlib.util
import sys

import numpy as np
import pytest
from PIL import Image, ImageSequence

from nmpm._support.atomic import atomic_write
from nmpm.errors import ConfigError
from nmpm.viz import write_animation
from nmpm.viz.colours import BACKGROUND, INTERIOR, WALL, material_colour
from nmpm.viz.frame_renderer import FrameRenderer
from nmpm.viz.gif_palette import FIXED_COLOURS, SIZE, GifPalette, _table_index


def frames_of(path):
    with Image.open(path) as file:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(file)]


def test_every_frame_is_in_the_gif(falling, tmp_path):
    frames = frames_of(write_animation(falling, tmp_path / "a.gif", side=100))
    assert len(frames) == falling.frame_count
    assert [file.name for file in tmp_path.iterdir()] == ["a.gif"]


def test_max_frames_limits_the_number_of_frames(falling, tmp_path):
    assert len(frames_of(write_animation(falling, tmp_path / "a.gif", side=100, max_frames=4))) == 4


def test_identical_frames_are_kept(falling, tmp_path):
    still = np.repeat(falling.positions["simulation"][:1], 6, axis=0)
    rest = dataclasses.replace(falling, positions={"simulation": still})
    assert len(frames_of(write_animation(rest, tmp_path / "rest.gif", side=100))) == 6


def test_the_gif_shows_the_drawn_frames(falling, tmp_path):
    """No pixels remain from earlier frames, and colours are close to those drawn."""
    renderer = FrameRenderer(falling, 160)
    for frame, shown in enumerate(frames_of(write_animation(falling, tmp_path / "a.gif", side=160))):
        drawn = renderer.draw(frame)
        assert shown.shape == drawn.shape
        difference = np.abs(shown.astype(int) - drawn)
        assert difference.mean() < 1
        assert np.quantile(difference, 0.999) < 40


def test_truth_is_left_and_prediction_right(falling):
    image = FrameRenderer(falling, 160).draw(5)
    water = np.abs(image.astype(int) - material_colour("water")).max(axis=2) < 5
    water[-30:] = False
    columns = np.flatnonzero(water.any(axis=0))
    assert columns.min() < image.shape[1] // 2 < columns.max()


def test_wide_boxes_are_stacked(falling):
    wide = dataclasses.replace(falling, bounds=((0, 4), (0, 1)), domain=None)
    one = dataclasses.replace(wide, positions={"simulation": wide.positions["simulation"]})
    assert FrameRenderer(wide, 160).width == FrameRenderer(one, 160).width
    assert FrameRenderer(wide, 160).height > FrameRenderer(one, 160).height


def test_frames_differ_where_particles_move(falling):
    renderer = FrameRenderer(falling, 160)
    middle = slice(60, renderer.height - 40)
    assert (renderer.draw(0)[middle] != renderer.draw(1)[middle]).any()


def test_frame_durations_follow_fps_and_the_last_frame_is_held(falling, tmp_path):
    with Image.open(write_animation(falling, tmp_path / "a.gif", side=100, fps=25, max_frames=3)) as file:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(file)]
    assert durations == [40, 40, 1000]


def test_a_single_frame_makes_a_gif(still, tmp_path):
    assert len(frames_of(write_animation(still([[0.5, 0.5]], ["water"]), tmp_path / "one.gif", side=100))) == 1


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="imageio-ffmpeg is not installed")
def test_the_mp4_has_all_frames(falling, tmp_path):
    import imageio.v3 as imageio

    path = write_animation(falling, tmp_path / "a.mp4", side=100)
    video = imageio.imread(path, plugin="FFMPEG")
    renderer = FrameRenderer(falling, 100)
    assert video.shape == (falling.frame_count, renderer.height, renderer.width, 3)


def test_a_missing_mp4_encoder_is_a_config_error(falling, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ConfigError, match=r"pip install nmpm\[video\].*\.gif"):
        write_animation(falling, tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.avi", "a"])
def test_an_unsupported_suffix_lists_the_supported(falling, tmp_path, name):
    with pytest.raises(ConfigError, match=r"\.gif or \.mp4"):
        write_animation(falling, tmp_path / name)


@pytest.mark.parametrize("setting", [{"fps": 0}, {"fps": 1000}, {"fps": float("nan")}, {"max_frames": 0}, {"side": 3}])
def test_settings_out_of_range_are_named(falling, tmp_path, setting):
    with pytest.raises(ConfigError, match=next(iter(setting))):
        write_animation(falling, tmp_path / "a.gif", **setting)


def test_the_palette_keeps_fixed_colours_and_rare_materials_exact():
    frame = np.full((40, 40, 3), BACKGROUND, dtype=np.uint8)
    frame[:20] = INTERIOR
    frame[:3] = WALL
    frame[30, 30] = material_colour("goop")
    shown = np.asarray(GifPalette([frame], [material_colour("goop")]).quantize(frame).convert("RGB"))
    np.testing.assert_array_equal(shown, frame)


def test_fixed_colours_have_different_table_cells():
    assert len({int(_table_index(np.array(colour, dtype=np.uint8))) for colour in FIXED_COLOURS}) == len(FIXED_COLOURS)


def test_no_colour_uses_the_transparent_entry():
    noise = np.random.default_rng(0).integers(0, 256, (100, 100, 3), dtype=np.uint8)
    assert np.asarray(GifPalette([noise]).quantize(noise)).max() < SIZE - 1


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.gif"
    path.write_text("old")

    def fail():
        with atomic_write(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
