import numpy as np
import pytest

from nmpm.data.format import Trajectory
from nmpm.data.statistics import MotionStatistics, find_disagreements, first_moving_particle
from tests.made_up import made_up_metadata, made_up_trajectory


def test_equal_those_computed_at_once():
    trajectories = [made_up_trajectory(12, 5), made_up_trajectory(9, 8, seed=1)]
    statistics = MotionStatistics(made_up_metadata())
    for trajectory in trajectories:
        statistics.add(trajectory)
    steps = [np.diff(t.position.astype(np.float64), axis=0) for t in trajectories]
    velocity = np.concatenate([step.reshape(-1, 2) for step in steps])
    acceleration = np.concatenate([np.diff(step, axis=0).reshape(-1, 2) for step in steps])
    found = statistics.result()
    np.testing.assert_allclose(found["vel_mean"], velocity.mean(0), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found["vel_std"], velocity.std(0), rtol=1e-9)
    np.testing.assert_allclose(found["acc_mean"], acceleration.mean(0), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found["acc_std"], acceleration.std(0), rtol=1e-9)


def test_static_particles_are_excluded():
    with_walls, without = MotionStatistics(made_up_metadata()), MotionStatistics(made_up_metadata())
    trajectory = made_up_trajectory(9, 6, statics=4)
    with_walls.add(trajectory)
    without.add(Trajectory(trajectory.position[:, :6], trajectory.particle_type[:6]))
    assert with_walls.result() == without.result()


def test_displacements_use_the_minimum_image():
    x = np.mod(0.1 + 0.3 * np.arange(8), 0.8) + 0.1
    position = np.stack([x, np.full(8, 0.5)], axis=-1)[:, None].astype(np.float32)
    statistics = MotionStatistics(made_up_metadata(periodic=(True, False)))
    statistics.add(Trajectory(position, np.array([7])))
    found = statistics.result()
    assert found["vel_mean"] == pytest.approx([0.3, 0.0], abs=1e-6)
    assert found["vel_std"] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert found["acc_std"] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_two_frames_have_no_acceleration():
    statistics = MotionStatistics(made_up_metadata())
    statistics.add(made_up_trajectory(2, 3))
    assert set(statistics.result()) == {"vel_mean", "vel_std"}


def test_small_differences_are_ignored():
    measured = {"vel_std": [1.0, 2.0], "acc_std": [1.0, 1.0]}
    assert find_disagreements(measured, {"vel_std": [1.09, 1.85], "acc_std": [1.0, 1.0]}) == []
    (sentence,) = find_disagreements(measured, {"vel_std": [1.2, 2.0]})
    assert "vel_std = (1.2, 2); these trajectories have (1, 2)" in sentence
    assert len(find_disagreements(measured, {"vel_std": [1.0]})) == 1
    assert find_disagreements(measured, {"vel_std": "unknown"}) == []


def test_first_moving_particle():
    position = np.zeros((4, 3, 2), np.float32)
    position[2, 2] = 0.01
    chosen = np.array([True, False, True])
    extent = ((0.0, 1.0), (0.0, 1.0))
    assert first_moving_particle(position, chosen, extent) == 2
    assert first_moving_particle(position, np.array([True, True, False]), extent) is None
    assert first_moving_particle(position, chosen, ((0.0, 100.0),) * 2) is None
