import dataclasses

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

from nmpm.errors import ConfigError
from nmpm.viz import write_snapshots
from nmpm.viz.colours import material_colour


def near(image, name, reach=6):
    return np.abs(image.astype(int) - material_colour(name)).max(axis=2) <= reach


def pixels(path):
    return np.asarray(Image.open(path).convert("RGB"))


def test_a_png_is_written_and_its_path_returned(falling, tmp_path):
    path = write_snapshots(falling, tmp_path / "rollout.png")
    assert Image.open(path).format == "PNG"
    assert [file.name for file in path.parent.iterdir()] == ["rollout.png"]


def test_the_size_follows_from_columns_and_rows(falling, tmp_path):
    three = pixels(write_snapshots(falling, tmp_path / "3.png", columns=3))
    six = pixels(write_snapshots(falling, tmp_path / "6.png", columns=6))
    alone = dataclasses.replace(falling, positions={"simulation": falling.positions["simulation"]})
    one_row = pixels(write_snapshots(alone, tmp_path / "1.png", columns=3))
    assert six.shape[0] == three.shape[0] > one_row.shape[0] + 330
    assert six.shape[1] - three.shape[1] == 3 * (330 + 12)
    assert one_row.shape[1] == three.shape[1]


def test_no_more_columns_than_frames(falling, tmp_path):
    few = pixels(write_snapshots(falling, tmp_path / "few.png", columns=11))
    many = pixels(write_snapshots(falling, tmp_path / "many.png", columns=40))
    np.testing.assert_array_equal(few, many)


def test_particles_fall_from_column_to_column(falling, tmp_path):
    image = pixels(write_snapshots(falling, tmp_path / "fall.png", columns=2))
    # The legend and the text are above the first panel.
    water = near(image, "water")
    water[:110] = False
    rows, columns = np.nonzero(water)
    first = columns < image.shape[1] // 2
    upper_first = rows[first].min()
    assert upper_first + 150 < rows[~first].min()


def test_the_prediction_is_drawn_below_the_truth(falling, tmp_path):
    image = pixels(write_snapshots(falling, tmp_path / "two.png", columns=1))
    water = near(image, "water")
    water[:110] = False
    rows = np.flatnonzero(water.any(axis=1))
    gaps = np.flatnonzero(np.diff(rows) > 1)
    assert len(gaps) == 1
    assert rows[gaps[0] + 1] - rows[0] == 330 + 12


def test_one_frame_is_enough(still, tmp_path):
    assert write_snapshots(still([[0.5, 0.5]], ["water"]), tmp_path / "one.png").exists()


def test_3d_is_drawn(still, tmp_path):
    image = pixels(write_snapshots(still([[0.5, 0.5, 0.5]], ["water"]), tmp_path / "three.png"))
    assert (image[..., 2].astype(int) - image[..., 0] > 60).any()


def test_matplotlib_settings_are_unchanged(falling, tmp_path):
    before = dict(mpl.rcParams)
    write_snapshots(falling, tmp_path / "a.png", columns=1)
    assert dict(mpl.rcParams) == before


def test_an_unsupported_suffix_lists_the_supported(falling, tmp_path):
    with pytest.raises(ConfigError, match=r"rollout\.bmp.*\.png"):
        write_snapshots(falling, tmp_path / "rollout.bmp")
    assert not list(tmp_path.iterdir())


def test_at_least_one_column(falling, tmp_path):
    with pytest.raises(ConfigError, match="columns = 0"):
        write_snapshots(falling, tmp_path / "a.png", columns=0)
