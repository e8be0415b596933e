import numpy as np
import pytest

from nmpm.data.format import Split, Trajectory, write_split
from nmpm.data.spacing import neighbour_distance
from nmpm.data.statistics import (
    MotionStatistics,
    displacements,
    extent_of,
    find_disagreements,
    first_moving_particle,
    first_outside,
)
from tests.made_up import made_up_metadata, made_up_trajectory


def test_statistics_of_moving_particles_equal_those_computed_at_once():
    trajectories = [made_up_trajectory(12, 5, statics=4), made_up_trajectory(9, 8, seed=1)]
    statistics = MotionStatistics(made_up_metadata())
    for trajectory in trajectories:
        statistics.add(trajectory)
    moving = [trajectory.position[:, trajectory.particle_type == 7].astype(np.float64) for trajectory in trajectories]
    for key, order in (("vel", 1), ("acc", 2)):
        values = np.concatenate([np.diff(position, order, axis=0).reshape(-1, 2) for position in moving])
        np.testing.assert_allclose(statistics.result()[f"{key}_mean"], values.mean(0), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(statistics.result()[f"{key}_std"], values.std(0), rtol=1e-9)


def test_displacements_use_the_minimum_image():
    x = np.mod(0.1 + 0.3 * np.arange(8), 0.8) + 0.1
    position = np.stack([x, np.full(8, 0.5)], axis=-1)[:, None].astype(np.float32)
    statistics = MotionStatistics(made_up_metadata(boundary=("periodic", "wall")))
    statistics.add(Trajectory(position[:2], np.array([7])))
    assert set(statistics.result()) == {"vel_mean", "vel_std"}  # two frames have no acceleration
    statistics.add(Trajectory(position, np.array([7])))
    for key, expected in (("vel_mean", [0.3, 0.0]), ("vel_std", [0.0, 0.0]), ("acc_std", [0.0, 0.0])):
        assert statistics.result()[key] == pytest.approx(expected, abs=1e-6)


def test_small_differences_are_ignored():
    measured = {"vel_std": [1.0, 2.0], "acc_std": [1.0, 1.0]}
    assert find_disagreements(measured, {"vel_std": [1.09, 1.85], "acc_std": [1.0, 1.0]}) == []
    (sentence,) = find_disagreements(measured, {"vel_std": [1.2, 2.0]})
    assert "vel_std = (1.2, 2); these trajectories have (1, 2)" in sentence
    assert len(find_disagreements(measured, {"vel_std": [1.0]})) == 1
    assert find_disagreements(measured, {"vel_std": "unknown"}) == []


@pytest.mark.filterwarnings("error")
def test_absent_particles_count_nowhere(tmp_path):
    metadata, trajectory = made_up_metadata(), made_up_trajectory(12, 20, statics=4)
    absent, types = trajectory.position.copy(), trajectory.particle_type
    absent[3, :5] = absent[0, 7] = absent[6] = absent[4:, 21] = np.nan
    extent = extent_of(absent)
    np.testing.assert_array_equal(extent.lower, np.nanmin(absent, axis=(0, 1)))
    extent.add(np.full((2, 3, 2), np.nan))
    np.testing.assert_array_equal(extent.upper, np.nanmax(absent, axis=(0, 1)))
    statistics = MotionStatistics(metadata)
    statistics.add(Trajectory(absent, types))
    steps = np.diff(absent[:, :20].astype(np.float64), axis=0)
    np.testing.assert_array_equal(displacements(absent[:, :20], metadata), steps)
    np.testing.assert_allclose(statistics.result()["vel_std"], np.nanstd(steps, axis=(0, 1)), rtol=1e-9)
    assert first_outside(absent, metadata.bounds, metadata.boundary) is None
    assert first_moving_particle(absent, types == 3, metadata.bounds) is None
    late = absent.copy()
    late[:9, 22] = np.nan
    late[10, 22] += 0.1
    assert first_moving_particle(late, types == 3, metadata.bounds) == 22
    write_split(tmp_path / "train.h5", [trajectory, Trajectory(absent[6:], types)])
    split = Split(tmp_path / "train.h5")
    assert neighbour_distance(split, [0], metadata) == pytest.approx(neighbour_distance(split, [1], metadata), rel=0.3)
