import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nmpm.errors import DataError
from nmpm.scene import Scene
from nmpm.viz import LabelledTrajectories, material_names
from nmpm.viz.trajectories import STRAIGHT


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_the_first_non_finite_position_is_reported(falling, bad):
    broken = falling.positions["prediction"].copy()
    broken[7, 1, 0] = bad
    with pytest.raises(DataError, match=r"'prediction'.*particle 1.*frame 7"):
        dataclasses.replace(falling, positions=dict(falling.positions, prediction=broken))


def test_trajectories_must_have_the_same_frames_and_particles(falling):
    with pytest.raises(DataError, match=r"'prediction'.*\(5, 2, 2\).*\(11, 2, 2\)"):
        dataclasses.replace(falling, positions=dict(falling.positions, prediction=falling.positions["prediction"][:5]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": {}}, "nothing to draw"),
        ({"positions": {"simulation": np.zeros((3, 4))}}, "shape"),
        ({"positions": {"simulation": np.zeros((3, 0, 2))}}, "shape"),
        ({"positions": {"simulation": np.zeros((3, 2, 1))}}, "shape"),
        ({"material": np.array(["water"])}, "one name for each of 2"),
        ({"bounds": ((0.1, 0.9),)}, "bounds"),
        ({"domain": ((0.9, 0.1), (0.1, 0.9))}, "domain"),
        ({"domain": ((0.0, 1e5), (0.0, 1.0))}, "too oblong to draw"),
        ({"obstacle": np.zeros((4, 3))}, "Obstacles"),
        ({"obstacle": np.full((4, 2), np.nan)}, "obstacle"),
        ({"periodic": (True,)}, "periodic"),
        ({"gravity": (0.0, 0.0, -9.81)}, "gravity"),
        ({"dt": 0.0}, "dt"),
    ],
)
def test_inconsistent_input_is_rejected(falling, change, message):
    with pytest.raises(DataError, match=message):
        dataclasses.replace(falling, **change)


def test_errors_are_root_mean_square_distances_from_the_first_trajectory(falling):
    assert list(falling.rms_errors()) == ["prediction"]
    np.testing.assert_allclose(falling.rms_errors()["prediction"], np.linspace(0, 0.03, 11))


def test_errors_are_minimum_image_distances_along_a_periodic_axis(falling):
    positions = {"simulation": np.full((1, 2, 2), 0.11), "prediction": np.full((1, 2, 2), 0.11)}
    positions["prediction"][..., 0] = 0.89
    periodic = dataclasses.replace(falling, positions=positions, periodic=(True, False))
    np.testing.assert_allclose(periodic.rms_errors()["prediction"], 0.02)


@given(frames=st.integers(1, 60), count=st.integers(1, 60))
def test_evenly_spaced_frames_are_distinct_and_include_both_ends(frames, count):
    trajectories = LabelledTrajectories(
        {"a": np.full((frames, 1, 2), 0.5)}, np.array(["water"]), bounds=((0, 1), (0, 1)), dt=1.0
    )
    indices = trajectories.evenly_spaced_frames(count)
    assert indices == sorted(set(indices))
    assert len(indices) == min(frames, count)
    assert indices[0] == 0
    if count > 1:
        assert indices[-1] == frames - 1


def test_from_scene_takes_the_box_and_the_names(falling):
    scene = Scene(
        bounds=((0.1, 0.9),) * 2,
        domain=((0.1, 0.9), (0.08, 0.92)),
        dt=0.0025,
        materials=("sand", "goop"),
        particle_volume=1e-4,
        boundary=("periodic", "wall"),
        gravity=(0.0, -9.81),
    )
    trajectories = LabelledTrajectories.from_scene(scene, falling.positions, np.array([1, 0]))
    assert trajectories.material.tolist() == ["goop", "sand"]
    assert trajectories.outer_bounds == scene.domain
    assert trajectories.periodic == (True, False)
    assert trajectories.gravity == scene.gravity


def test_type_ids_are_converted_to_names():
    assert material_names([6, 5, 6], {5: "water", 6: "sand"}).tolist() == ["sand", "water", "sand"]
    assert material_names([1, 0], ["water", "sand"]).tolist() == ["sand", "water"]


def test_a_type_id_without_a_name_is_reported():
    with pytest.raises(DataError, match=r"type 9 .*5 water"):
        material_names([5, 9], {5: "water"})


@given(st.floats(-3.1, 3.1), st.floats(1e-6, 100))
def test_tilt_is_the_angle_by_which_gravity_is_turned_from_down(angle, strength):
    down = np.array([0.0, -strength])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    trajectories = LabelledTrajectories(
        {"a": np.full((1, 1, 2), 0.5)}, np.array(["water"]), ((0, 1),) * 2, 1.0, gravity=tuple(turn @ down)
    )
    if abs(angle) < 0.99 * STRAIGHT:
        assert trajectories.tilt is None
    elif abs(angle) > 1.01 * STRAIGHT:
        assert trajectories.tilt == pytest.approx(angle)


@pytest.mark.parametrize("gravity", [None, (0.0, -9.81), (0.0, 0.0), (0.05, -9.81)])
def test_gravity_that_is_down_zero_or_unknown_has_no_tilt(falling, gravity):
    assert dataclasses.replace(falling, gravity=gravity).tilt is None


def test_in_3d_gravity_has_no_tilt(still):
    assert still([[0.5, 0.5, 0.5]], ["water"], gravity=(9.81, 0.0, 0.0)).tilt is None


def test_a_trajectory_may_have_a_gravity_of_its_own(falling):
    scene = Scene(((0.1, 0.9),) * 2, ((0.0, 1.0),) * 2, 0.0025, ("goop",), 1e-4, gravity_varies=True)
    own = LabelledTrajectories.from_scene(scene, falling.positions, np.array([0, 0]), gravity=[9.81, 0.0])
    assert own.gravity == (9.81, 0.0)
    assert LabelledTrajectories.from_scene(scene, falling.positions, np.array([0, 0])).gravity is None
