import base64
import dataclasses
import json
import re
import zlib

import numpy as np
import pytest

from nmpm import view
from nmpm.cli import main
from nmpm.data.format import Trajectory, write_metadata, write_split
from nmpm.errors import ConfigError, DataError
from nmpm.viz import LabelledTrajectories
from nmpm.viz.page import STEPS, pack_positions, quantize
from tests.made_up import made_up_metadata, made_up_trajectory


def unpack(text: str, shape: tuple[int, ...]) -> np.ndarray:
    raw = np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype=np.uint8).astype(np.uint16)
    low, high = raw.reshape(2, -1)
    return (low | high << 8).reshape(shape).cumsum(axis=0, dtype=np.uint16)


def description(page) -> dict:
    return json.loads(re.search(r'type="application/json">(.*?)</script>', page.html, re.DOTALL)[1])


@pytest.mark.parametrize("shape", [(1, 1, 2), (6, 9, 3)])
def test_positions_come_back_within_half_a_step(shape):
    rng = np.random.default_rng(0)
    low, high = np.sort(rng.normal(scale=10, size=(2, shape[-1])), axis=0) + np.array([[-1e-3], [1e-3]])
    position = rng.uniform(low, high, size=shape)
    steps = unpack(pack_positions(quantize(position, low, high)), position.shape)
    assert np.all(np.abs(low + steps * (high - low) / STEPS - position) <= 0.5001 * (high - low) / STEPS)


def test_the_page_describes_frames_box_and_errors(falling):
    shown = description(view(falling, every=2))
    assert [each["label"] for each in shown["trajectories"]] == list(falling.positions)
    assert (shown["frames"], shown["every"], shown["dim"]) == ((falling.frame_count + 1) // 2, 2, falling.dim)
    assert shown["dt"] == pytest.approx(2 * falling.dt)
    errors = falling.rms_errors()["prediction"][::2]
    assert shown["trajectories"][1]["errors"] == pytest.approx(errors, rel=1e-5)
    with pytest.raises(ConfigError, match="every = 0"):
        view(falling, every=0)


def test_names_cannot_leave_the_data():
    hostile = "</script><script>alert(1)</script>"
    trajectories = LabelledTrajectories(
        {hostile: np.full((2, 1, 2), 0.5)}, np.array([hostile]), bounds=((0, 1), (0, 1)), dt=1.0, title=hostile
    )
    page = view(trajectories)
    assert not re.findall(r"""(?:src|href)=|url\(|https?://|import\(""", page.html)  # nothing is loaded from elsewhere
    assert page._repr_html_().startswith("<iframe srcdoc=")
    assert 'sandbox="allow-scripts allow-downloads"' in page._repr_html_()
    assert "alert(1)</script>" not in page.html
    assert description(page)["title"] == hostile
    assert "<script>alert" not in page._repr_html_()


def test_fields_are_packed_within_their_colour_scale(falling):
    frames, count = next(iter(falling.positions.values())).shape[:2]
    first, second = falling.positions
    warm = np.linspace(280.0, 320.0, frames * count).reshape(frames, count)
    fields = {"temperature": {first: warm, second: warm + 1}, "stiffness": {second: np.arange(count)[None]}}
    shown = description(view(dataclasses.replace(falling, fields=fields), every=2))["fields"]
    assert [each["name"] for each in shown] == ["temperature", "stiffness"]
    low, high = shown[0]["low"], shown[0]["high"]
    assert 280 < low < 281
    assert 320 < high < 321
    steps = unpack(shown[0]["values"][0], warm[::2].shape)
    assert np.allclose(low + steps * (high - low) / STEPS, warm[::2].clip(low, high), atol=1e-3)
    assert shown[1]["values"][0] is None
    constant = unpack(shown[1]["values"][1], warm[::2].shape)
    assert np.all(constant == constant[0])
    assert np.all(np.diff(constant[0].astype(int)) >= 0)


def test_declared_fields_of_files_are_shown_beside_those_of_the_truth(tmp_path):
    metadata = dataclasses.replace(made_up_metadata(), fields=("temperature", "stiffness_of_all", "label"))
    write_metadata(tmp_path, metadata)
    truth = made_up_trajectory(6, 5, statics=2)
    warm = np.linspace(300, 310, 42, dtype=np.float32).reshape(6, 7)
    warm[:, 5:] = np.nan  # what does not move needs no value
    fields = {"temperature": warm, "label": np.arange(7), "stiffness_of_all": np.float32(2)}
    written = dataclasses.replace(truth, fields=fields)
    for split in ("train", "test"):
        write_split(tmp_path / f"{split}.h5", [written])
    write_split(tmp_path / "out.h5", [dataclasses.replace(written, fields=fields | {"temperature": warm + 1})])
    shown = description(view(tmp_path / "out.h5", truth=tmp_path / "test.h5"))["fields"]
    assert {each["name"] for each in shown} == {"temperature", "label"}  # a number of the scene colours nothing
    (warmth,) = (each for each in shown if each["name"] == "temperature")
    colder, warmer = (unpack(values, (6, 5)).astype(int) for values in warmth["values"])
    assert np.all(warmer >= colder)
    assert np.any(warmer > colder)


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_metadata(tmp_path, made_up_metadata())
    truth = made_up_trajectory(6, 5, statics=2)
    write_split(tmp_path / "test.h5", [made_up_trajectory(6, 5, seed=9), truth])
    longer = made_up_trajectory(8, 5, statics=2)
    moved = np.r_[truth.position[:2], longer.position[2:] + 0.01]
    write_split(tmp_path / "out.h5", [Trajectory(moved, truth.particle_type, {})])
    write_split(tmp_path / "fewer.h5", [made_up_trajectory(6, 4)])
    return tmp_path


def test_view_compares_with_the_truth_over_common_frames(dataset, capsys):
    assert main(["view", "out.h5", "test.h5", "--truth-trajectory", "1"]) == 0
    assert re.match(r"wrote out.html \(0\.\d MB\)", capsys.readouterr().out)
    shown = description(view(dataset / "out.h5"))
    assert shown["frames"] == 8
    page = (dataset / "out.html").read_text(encoding="utf-8")
    compared = json.loads(re.search(r'type="application/json">(.*?)</script>', page, re.DOTALL)[1])
    assert compared["frames"] == 6
    errors = compared["trajectories"][1]["errors"]
    assert errors[:2] == [0, 0]
    assert all(error > 0 for error in errors[2:])


@pytest.mark.usefixtures("dataset")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["view", "out.h5", "test.h5"], "do not start at the same positions"),
        (["view", "fewer.h5", "test.h5"], "5 moving ones in 2-D, and 4"),
        (["view", "out.h5", "--out", "page.png"], "must end in .html"),
        (["view", "out.h5", "--every", "0"], "--every 0"),
        (["view", "out.h5", "--trajectory", "3"], "trajectories 0 … 0"),
    ],
)
def test_mistakes_are_one_line_and_write_nothing(words, message, dataset, capsys):
    assert main(words) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(dataset.glob("*.html"))


def test_a_trajectory_is_shown_with_its_own_gravity(tmp_path):
    write_metadata(tmp_path, made_up_metadata())
    pulls = ([9.81, 0.0], [0.0, -9.81])
    tilted = [dataclasses.replace(made_up_trajectory(6, 5), attributes={"gravity": pull}) for pull in pulls]
    write_split(tmp_path / "train.h5", tilted)
    assert description(view(tmp_path / "train.h5"))["tilt"] == pytest.approx(np.pi / 2)
    wrong = dataclasses.replace(made_up_trajectory(6, 5), attributes={"gravity": "down"})
    write_split(tmp_path / "out.h5", [wrong])
    with pytest.raises(DataError, match=r"out.h5, trajectory 0: the attribute gravity = .* should be 2 finite numbers"):
        view(tmp_path / "out.h5")


def test_further_members_are_packed_coarsely_and_thinned_out_beyond_a_size(falling, monkeypatch):
    shown = falling.positions["prediction"]
    ensemble = dataclasses.replace(falling, further_members={"member 1": shown + 0.01})
    page = description(view(ensemble))
    low, high = np.array(page["low"]), np.array(page["high"])
    steps = unpack(page["members"][0]["positions"], shown.shape)
    assert np.all(np.abs(low + steps * (high - low) / 65535 - shown - 0.01) <= 16 * (high - low) / STEPS)
    assert page["bands"]["stride"] == 1
    assert len(page["curves"][0]["members"]) == 2
    monkeypatch.setattr("nmpm.viz.viewer.MEMBER_BYTES", shown.size)  # half of what it takes
    thinned = description(view(ensemble))
    assert thinned["bands"]["stride"] == 2
    np.testing.assert_array_equal(unpack(thinned["members"][0]["positions"], shown[:, ::2].shape), steps[:, ::2])
