import dataclasses
import itertools
import string

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nmpm.errors import DataError
from nmpm.scene import Scene
from nmpm.viz import LabelledTrajectories, material_names
from nmpm.viz.colours import FALLBACK_COLOURS, INTERIOR, MATERIAL_COLOURS, OBSTACLE, material_colours, vary_brightness
from nmpm.viz.trajectories import STRAIGHT


def test_the_first_non_finite_position_is_reported(falling):
    broken = falling.positions["prediction"].copy()
    broken[7, 1, 0] = np.inf
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
        ({"dt": 1e308}, "dt"),  # whose eleven frames take infinitely long
        ({"fields": {"heat": {"nobody": np.zeros((1, 1))}}}, "heat is of 'nobody'"),
        ({"fields": {"heat": {"prediction": np.zeros((2, 4))}}}, r"heat of 'prediction' has shape \(2, 4\)"),
        ({"fields": {"heat": {"prediction": np.array([[0.0, np.nan]])}}}, "is nan for particle 1 in frame 0"),
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
    tilted = LabelledTrajectories.from_scene(scene, falling.positions, np.array([1, 0]), gravity=[9.81, 0.0])
    assert tilted.gravity == (9.81, 0.0)


def test_type_ids_are_converted_to_names():
    assert material_names([6, 5, 6], {5: "water", 6: "sand"}).tolist() == ["sand", "water", "sand"]
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


def test_gravity_that_is_down_zero_or_unknown_or_in_3d_has_no_tilt(falling, still):
    for gravity in (None, (0.0, -9.81), (0.0, 0.0), (0.05, -9.81)):
        assert dataclasses.replace(falling, gravity=gravity).tilt is None
    assert still([[0.5, 0.5, 0.5]], ["water"], gravity=(9.81, 0.0, 0.0)).tilt is None


COMMON_MATERIALS = ["water", "sand", "goop", "elastic", "rigid", "boundary"]

# Machado, Oliveira & Fernandes 2009, severity 1, on linear RGB.
VISION = {
    "full": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}


def lab(rgb, vision):
    """CIELAB of an sRGB colour as seen with this vision (D65)."""
    value = np.array(rgb) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    linear = np.clip(VISION[vision] @ linear, 0, 1)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(to_xyz @ linear / to_xyz.sum(axis=1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", VISION)
def test_materials_are_distinguishable_from_each_other_and_from_the_background(vision):
    shown = material_colours(COMMON_MATERIALS) | {"background": INTERIOR}
    for one, other in itertools.combinations(shown, 2):
        distance = np.linalg.norm(lab(shown[one], vision) - lab(shown[other], vision))
        assert distance > 15, (one, other)


@given(st.lists(st.text(string.ascii_lowercase, min_size=1), unique=True, max_size=len(FALLBACK_COLOURS)))
def test_unknown_materials_of_a_scene_have_different_colours_in_the_given_order(names):
    unknown = [name for name in names if name not in MATERIAL_COLOURS]
    colours = material_colours(unknown)
    assert list(colours) == unknown
    assert len(set(colours.values())) == len(unknown)
    assert set(colours.values()) <= set(FALLBACK_COLOURS)


def test_colours_are_the_same_in_every_run():
    assert material_colours(["debris", "boundary"]) == {"debris": FALLBACK_COLOURS[4], "boundary": OBSTACLE}


def test_brightness_varies_a_little_around_the_colour():
    water = material_colours(["water"])["water"]
    plain = np.tile(np.array(water, dtype=np.uint8), (200, 1))
    varied = vary_brightness(plain)
    assert tuple(varied[0]) == water
    assert 1 < len(np.unique(varied, axis=0)) < 8
    assert np.abs(varied.astype(int) - plain).max() < 45
