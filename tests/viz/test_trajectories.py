import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nmpm.colours import FALLBACK_COLOURS, INTERIOR, OBSTACLE, material_colours
from nmpm.errors import DataError
from nmpm.scene import Scene
from nmpm.viz import LabelledTrajectories, material_names


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": {}}, "nothing to draw"),
        ({"positions": {"simulation": np.zeros((3, 2, 1))}}, "shape"),
        ({"positions": {"a": np.zeros((3, 2, 2)), "b": np.zeros((5, 2, 2))}}, r"'b'.*\(5, 2, 2\).*\(3, 2, 2\)"),
        ({"positions": {"a": np.array([[[0.5, 0.5], [np.inf, 0.5]]])}}, "'a', particle 1 is at .* in frame 0"),
        ({"material": np.array(["water"])}, "one name for each of 2"),
        ({"bounds": ((0.1, 0.9),)}, "bounds"),
        ({"domain": ((0.9, 0.1), (0.1, 0.9))}, "domain"),
        ({"domain": ((0.0, 1e5), (0.0, 1.0))}, "too oblong to draw"),
        ({"obstacle": np.zeros((4, 3))}, "Obstacles"),
        ({"periodic": (True,)}, "periodic"),
        ({"dt": 1e308}, "dt"),  # whose eleven frames take infinitely long
        ({"fields": {"heat": {"nobody": np.zeros((1, 1))}}}, "heat is of 'nobody'"),
        ({"fields": {"heat": {"prediction": np.zeros((2, 4))}}}, r"heat of 'prediction' has shape \(2, 4\)"),
        ({"fields": {"heat": {"prediction": np.array([[0.0, np.nan]])}}}, "heat of 'prediction', particle 1 is at nan"),
    ],
)
def test_inconsistent_input_is_rejected(falling, change, message):
    with pytest.raises(DataError, match=message):
        dataclasses.replace(falling, **change)


def test_errors_are_root_mean_square_distances_from_the_first_trajectory(falling):
    assert list(falling.rms_errors()) == ["prediction"]
    np.testing.assert_allclose(falling.rms_errors()["prediction"], np.linspace(0, 0.03, 11))
    # The shortest way along a periodic axis.
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
    assert count == 1 or indices[-1] == frames - 1


def test_from_scene_takes_the_box_and_the_names(falling):
    scene = Scene(
        bounds=((0.1, 0.9),) * 2, domain=((0.1, 0.9), (0.08, 0.92)), dt=0.0025, materials=("sand", "goop"),
        particle_volume=1e-4, boundary=("periodic", "wall"), gravity=(0.0, -9.81),
    )  # fmt: skip
    trajectories = LabelledTrajectories.from_scene(scene, falling.positions, np.array([1, 0]))
    assert trajectories.material.tolist() == ["goop", "sand"]
    assert trajectories.outer_bounds == scene.domain
    assert trajectories.periodic == (True, False)
    assert trajectories.gravity == scene.gravity
    tilted = LabelledTrajectories.from_scene(scene, falling.positions, np.array([1, 0]), gravity=[9.81, 0.0])
    assert tilted.gravity == (9.81, 0.0)


def test_type_ids_are_converted_to_names():
    assert material_names([6, 5, 6], {5: "water", 6: "sand"}).tolist() == ["sand", "water", "sand"]
    with pytest.raises(DataError, match=r"type 9 .*5 water"):
        material_names([5, 9], {5: "water"})


def test_tilt_is_the_angle_by_which_gravity_is_turned_from_down(falling, still):
    for angle in (-3.0, -0.02, 0.02, 1.5):
        gravity = (9.81 * math.sin(angle), -9.81 * math.cos(angle))
        assert dataclasses.replace(falling, gravity=gravity).tilt == pytest.approx(angle)
    for gravity in (None, (0.0, -9.81), (0.0, 0.0), (0.05, -9.81)):
        assert dataclasses.replace(falling, gravity=gravity).tilt is None
    assert still([[0.5, 0.5, 0.5]], ["water"], gravity=(9.81, 0.0, 0.0)).tilt is None


# Machado, Oliveira & Fernandes 2009, severity 1, on linear RGB.
VISION = {
    "full": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
}


def lab(rgb, vision):
    """CIELAB of an sRGB colour as seen with this vision (D65)."""
    value = np.array(rgb) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    linear = np.clip(np.array(VISION[vision]) @ linear, 0, 1)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(to_xyz @ linear / to_xyz.sum(axis=1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", VISION)
def test_materials_are_distinguishable_from_each_other_and_from_the_background(vision):
    names = ["water", "sand", "goop", "elastic", "snow", "rigid", "boundary"]
    shown = [*material_colours(names).values(), *FALLBACK_COLOURS, INTERIOR]
    for one, other in itertools.combinations(shown, 2):
        assert np.linalg.norm(lab(one, vision) - lab(other, vision)) > 15, (one, other)


def test_unknown_materials_have_different_colours_in_the_given_order_that_are_the_same_in_every_run():
    names = ["lava", "debris", "mud", "tar", "ash", "boundary"]
    colours = material_colours(names)
    assert list(colours) == names
    assert len(set(colours.values())) == len(names)
    assert material_colours(["debris", "boundary"]) == {"debris": FALLBACK_COLOURS[4], "boundary": OBSTACLE}


def test_eventful_frames_leave_out_those_at_rest(still):
    """One particle crosses the box in frames 10 to 30 of 100."""
    along = np.clip((np.arange(101) - 10) / 20, 0, 1)
    moving = dataclasses.replace(
        still([[0.5, 0.5]], ["water"]), positions={"truth": np.stack([along, along], axis=1)[:, None]}
    )
    frames = moving.eventful_frames(6)
    assert (frames[0], frames[-1], len(frames)) == (0, 100, 6)
    assert all(10 <= frame <= 32 for frame in frames[1:-1])
    resting = dataclasses.replace(moving, positions={"truth": np.full((101, 1, 2), 0.5)})
    assert resting.eventful_frames(6) == [0, 20, 40, 60, 80, 100]
    assert resting.eventful_frames(1) == [0]
    assert still([[0.5, 0.5]], ["water"]).eventful_frames(6) == [0]
