import numpy as np
import pytest
import yaml

from nmpm.data.format import Trajectory, write_metadata, write_split
from nmpm.data.grid_rule import Machine
from nmpm.data.new_configuration import CompletedSource, SettingsChoice
from nmpm.data.sources import FolderSource
from nmpm.errors import DataError
from tests.made_up import made_up_metadata

STEP = 9.81 * 0.0025**2  # of gravity, per frame²


def falling(frames=60, lift=0.0, noise=0.0, shift=0.0, dim=2):
    """A block of goop in free fall, stopped at the floor; `lift` accelerates it upwards, in units of gravity."""
    axis = 0.3 + 0.01 * np.arange(12)
    block = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1).reshape(1, -1, dim)
    time = np.arange(frames)[:, None]
    position = np.repeat(block, frames, axis=0)
    position[..., 0] += shift
    position[..., -1] = np.maximum(position[..., -1] + 0.5 * (lift - 1) * STEP * time**2, 0.1)
    position += np.random.default_rng(0).normal(0, noise, position.shape) if noise else 0.0
    return Trajectory(position.astype(np.float32), np.full(position.shape[1], 7))


def written(folder, *runs, splits=("train", "valid", "test"), **changes):
    folder.mkdir(exist_ok=True)
    for name in splits:
        write_split(folder / f"{name}.h5", runs)
    known = {"particle_volume": 0.01 ** runs[0].position.shape[2], "sequence_length": len(runs[0].position) - 1}
    write_metadata(folder, made_up_metadata(runs[0].position.shape[2], **(known | changes)))
    return configured(folder)


def configured(folder, minutes=15):
    choice = SettingsChoice.of(CompletedSource.of(FolderSource(folder)), Machine(minutes=minutes))
    text = choice.configuration(str(folder), "runs/here")
    return yaml.safe_load(text), text


def test_a_fall_that_ends_on_the_floor_keeps_its_energy_and_comes_to_rest(tmp_path):
    config, text = written(tmp_path, falling(frames=400))
    assert config["model"]["constraints"] == {"energy": True, "rest_speed": 0.01}
    assert config["model"]["mirror"] == [0]
    assert config["data"]["emphasis"] == 0.7
    assert config["data"]["path"] == str(tmp_path)
    assert config["trainer"]["max_time"] == "00:00:15:00"
    assert "openings" not in config["data"]
    assert len(text.splitlines()) < 50
    assert max(map(len, text.splitlines()[2:])) <= 120


def test_gravity_that_nobody_states_is_measured_in_the_units_of_the_metadata(tmp_path):
    config, text = written(tmp_path, falling(frames=40), gravity=None)
    assert config["data"]["gravity"] == pytest.approx([0.0, -9.81], rel=1e-2)
    assert "free flight" in text


@pytest.mark.parametrize(
    ("run", "changes", "reason"),
    [
        (falling(lift=2.5), {"bounds": ((0.1, 9.0),) * 2}, "energy rises in the data"),
        (falling(), {"boundary": ("wall", "open")}, "particles come and go"),
    ],
)
def test_energy_is_not_limited_where_it_comes_in(tmp_path, run, changes, reason):
    config, text = written(tmp_path, run, **changes)
    assert config["model"]["constraints"] == {"energy": False, "rest_speed": 0.0}
    assert "mirror" not in config["model"]
    assert f"# energy: not limited, as {reason}" in text


def test_noisy_positions_are_smoothed(tmp_path, monkeypatch):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    config, text = written(tmp_path / "data", falling(noise=0.002))
    assert config["data"]["smooth"] == 13
    assert "positions have a noise of 0.002," in text


def test_uneven_frames_are_resampled(tmp_path, monkeypatch):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))
    run = falling()
    times = 0.0025 * np.delete(np.arange(61), 30)
    run = Trajectory(run.position, run.particle_type, {}, {"time": times})
    config, _ = written(tmp_path / "data", run)
    assert config["data"]["resample"] == 0.0025


def test_short_trajectories_are_unrolled_over_fewer_bundles(tmp_path):
    config, _ = written(tmp_path, falling(frames=20))
    assert (config["model"]["frames"], config["model"]["unroll"]) == (8, 2)


def test_three_dimensions_and_long_trainings(tmp_path):
    written(tmp_path, falling(dim=3), splits=("train",))
    config, _ = configured(tmp_path, minutes=60)
    assert config["model"]["unroll"] == 2
    assert config["model"]["processor"]["init_args"]["width"] == 16  # for 2000 steps
    assert config["model"]["cells"] == 40
    assert config["model"]["optimizer"]["init_args"]["lr"] == 3.0e-3
    assert config["trainer"]["limit_val_batches"] == 0  # no valid split


def test_a_dataset_without_training_trajectories_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"no train split \(found: test\)"):
        written(tmp_path, falling(), splits=("test",))
