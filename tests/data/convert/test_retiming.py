"""Positions at even times, and smoothed ones."""

import numpy as np
import pytest

from nmpm.data.convert import Options, convert
from nmpm.data.convert.retiming import resample, smooth
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.format import Split, Trajectory, read_metadata, write_metadata, write_split
from nmpm.data.sources import FolderSource
from nmpm.data.times import uneven_step, usual_step
from nmpm.errors import ConfigError, DataError
from tests.made_up import made_up_metadata

METADATA = made_up_metadata(bounds=((0.0, 1.0), (0.0, 1.0)))


def parabolas(time: np.ndarray, particles: int = 6) -> np.ndarray:
    """(T, N, 2) float32 positions of particles that fly freely."""
    rng = np.random.default_rng(0)
    start, speed, pull = rng.uniform(0.3, 0.6, (3, particles, 2)) * np.array([1, 0.5, -0.4])[:, None, None]
    t = time[:, None, None]
    return (start + speed * t + pull * t**2).astype(np.float32)


def trajectory(position: np.ndarray, **fields: np.ndarray) -> Trajectory:
    return Trajectory(position, np.full(position.shape[1], 7), fields=fields)


@pytest.fixture
def uneven() -> np.ndarray:
    """(30,) times with steps from 0.01 to 0.03, the first of them three times as long as the last."""
    return np.concatenate([[0.0], np.cumsum(np.linspace(0.03, 0.01, 29))])


def test_resampling_is_exact_on_parabolas_and_leaves_gaps(uneven):
    position = parabolas(uneven)
    position[10:13, 1] = position[:5, 2] = position[6:, 3] = np.nan
    heat = (uneven**3)[:, None] * np.ones(6)
    cluster = np.arange(30)[:, None] * np.ones(6, int)
    new = resample(trajectory(position, heat=heat, cluster=cluster, time=uneven), uneven, 0.01, METADATA)
    time = new.fields["time"]
    np.testing.assert_allclose(time, 0.01 * np.arange(len(time)), atol=1e-12)
    assert uneven[-1] - 0.01 < time[-1] <= uneven[-1] + 1e-9
    expected = parabolas(time)
    expected[(time > uneven[9] + 1e-3) & (time < uneven[13] - 1e-3), 1] = np.nan
    expected[time < uneven[5] - 1e-3, 2] = expected[time > uneven[5] + 1e-3, 3] = np.nan
    np.testing.assert_allclose(new.position, expected, atol=2e-6)
    np.testing.assert_allclose(new.fields["heat"], (time**3)[:, None] * np.ones(6), atol=1e-9)
    nearest = np.abs(uneven[:, None] - time).argmin(axis=0)
    np.testing.assert_array_equal(new.fields["cluster"][:, 0], nearest)


def test_missing_frames_are_gaps_and_borders_are_crossed_the_short_way():
    time = np.delete(np.arange(20) * 0.1, [8, 9, 10])
    position = np.stack([np.mod(0.9 + 0.7 * time, 1.0), 0.5 + 0 * time], axis=-1)[:, None].astype(np.float32)
    periodic = made_up_metadata(bounds=((0.0, 1.0),) * 2, boundary=("periodic", "wall"))
    new = resample(trajectory(position), time, 0.05, periodic)
    fine = new.fields["time"]
    there = (fine < 0.71) | (fine > 1.09)
    np.testing.assert_array_equal(np.isnan(new.position[:, 0, 0]), ~there)
    np.testing.assert_allclose(new.position[there, 0, 0], np.mod(0.9 + 0.7 * fine[there], 1.0), atol=1e-6)


def test_smoothing_is_exact_on_parabolas_also_at_ends_and_gaps():
    position = parabolas(np.arange(20) * 0.02)
    position[7, 1] = position[4:, 2] = position[3:5, 3] = np.nan
    kept = smooth(trajectory(position), 5, METADATA).position
    np.testing.assert_allclose(kept, position, atol=1e-6)


def test_smoothing_takes_the_known_part_of_the_noise():
    rng, clean = np.random.default_rng(1), parabolas(np.arange(200) * 0.002, 400).astype(np.float64)
    noise = 1e-3 * rng.normal(size=clean.shape)
    smoothed = smooth(trajectory((clean + noise).astype(np.float32)), 5, METADATA).position
    inner = (smoothed - clean)[2:-2]
    assert inner.std() == pytest.approx(1e-3 * np.sqrt(17 / 35), rel=0.02)  # the middle weight of the fit is 17/35


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        (np.arange(50) / 240, None),
        (np.round(np.arange(50) / 240, 4), None),  # steps of 41 and 42, rounded to 4 decimals
        (np.arange(50), None),
        (np.delete(np.arange(50) * 0.004, 20), (20, 2.0)),
        (np.delete(np.arange(50), 20), (20, 2.0)),
        (np.array([0.0, 1.0, 2.0, 1.5, 2.5]), (3, -0.5)),
        (np.array([0.3]), None),
    ],
    ids=["even", "rounded", "numbers", "gap", "numbers with a gap", "back", "one"],
)
def test_uneven_steps_are_told_from_rounding(time, expected):
    assert uneven_step(time) == (pytest.approx(expected) if expected else None)


def test_the_usual_step_of_rounded_times_is_exact():
    assert usual_step(np.round(np.arange(481) / 240, 4)) == pytest.approx(1 / 240, rel=1e-6)
    assert usual_step(np.delete(np.arange(50) * 0.004, 20)) == pytest.approx(0.004)


@pytest.mark.usefixtures("home")
def test_uneven_native_data_are_refused_and_resampled_in_a_copy(tmp_path, uneven):
    folder, files = tmp_path / "data", {}
    for name in ("train", "valid"):
        write_split(folder / f"{name}.h5", [trajectory(parabolas(uneven), time=uneven)])
        files[name] = (folder / f"{name}.h5").read_bytes()
    write_metadata(folder, METADATA)
    refused = TrajectoryDataModule(str(folder), horizon=4)
    with pytest.raises(DataError, match=r"trajectory 00000: its steps in time are uneven: frame 29 is 0.5 usual steps"):
        refused.setup("fit")
    module = TrajectoryDataModule(str(folder), horizon=4, resample=0.02, smooth=5)
    module.setup("fit")
    assert module.scene.dt == 0.02
    assert module.data_source.folder != folder
    frames = next(iter(module.val_dataloader())).frames[0]
    np.testing.assert_allclose(frames, parabolas(0.02 * np.arange(len(frames))), atol=2e-6)
    assert {name: (folder / f"{name}.h5").read_bytes() for name in files} == files
    notes = read_metadata(module.data_source.folder).extra["conversion"]
    assert any("errors are against these" in note for note in notes)


def test_even_frames_need_no_times_and_others_a_step(tmp_path):
    position = parabolas(np.arange(12) * METADATA.dt)
    write_split(tmp_path / "in" / "train.h5", [trajectory(position)])
    write_metadata(tmp_path / "in", METADATA)
    convert(tmp_path / "in", tmp_path / "out", options=Options(resample=2 * METADATA.dt))
    assert read_metadata(tmp_path / "out").dt == 2 * METADATA.dt
    np.testing.assert_allclose(Split(tmp_path / "out" / "train.h5").read(0).position, position[::2], atol=1e-6)
    with pytest.raises(DataError, match=r"from 0 to 0.0275 cannot be resampled to steps of 1"):
        convert(tmp_path / "in", tmp_path / "none", options=Options(resample=1.0))
    np.savez(tmp_path / "runs.npz", positions=np.stack([position] * 3))
    with pytest.raises(DataError, match=r"without times cannot be resampled.*--dt"):
        FolderSource(tmp_path / "runs.npz", Options(resample=1.0)).folder  # noqa: B018


@pytest.mark.parametrize("options", [{"resample": 0.0}, {"smooth": 4}, {"smooth": 3}])
def test_options_without_a_meaning_are_refused(options):
    with pytest.raises(ConfigError, match=next(iter(options))):
        Options(**options)
