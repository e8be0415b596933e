import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nmpm.errors import DataError
from nmpm.scene import Scene
from nmpm.viz import Exhibit, material_names


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_position_that_is_not_finite_is_named(falling, bad):
    broken = falling.rows["prediction"].copy()
    broken[7, 1, 0] = bad
    with pytest.raises(DataError, match=r"'prediction'.*particle 1.*frame 7"):
        dataclasses.replace(falling, rows=dict(falling.rows, prediction=broken))


def test_rows_must_match_in_frames_and_particles(falling):
    with pytest.raises(DataError, match=r"'prediction'.*\(5, 2, 2\).*\(11, 2, 2\)"):
        dataclasses.replace(falling, rows=dict(falling.rows, prediction=falling.rows["prediction"][:5]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": {}}, "nothing to draw"),
        ({"rows": {"simulation": np.zeros((3, 4))}}, "shape"),
        ({"rows": {"simulation": np.zeros((3, 0, 2))}}, "shape"),
        ({"rows": {"simulation": np.zeros((3, 2, 1))}}, "shape"),
        ({"material": np.array(["water"])}, "one name for each of 2"),
        ({"bounds": ((0.1, 0.9),)}, "bounds"),
        ({"domain": ((0.9, 0.1), (0.1, 0.9))}, "domain"),
        ({"obstacle": np.zeros((4, 3))}, "Obstacles"),
        ({"obstacle": np.full((4, 2), np.nan)}, "obstacle"),
        ({"periodic": (True,)}, "periodic"),
        ({"gravity": (0.0, 0.0, -9.81)}, "gravity"),
        ({"dt": 0.0}, "dt"),
    ],
)
def test_what_does_not_fit_together_is_refused(falling, change, message):
    with pytest.raises(DataError, match=message):
        dataclasses.replace(falling, **change)


def test_errors_are_root_mean_square_distances_from_the_first_row(falling):
    assert list(falling.errors()) == ["prediction"]
    np.testing.assert_allclose(falling.errors()["prediction"], np.linspace(0, 0.03, 11))


def test_errors_take_the_short_way_round_a_periodic_axis(falling):
    rows = {"simulation": np.full((1, 2, 2), 0.11), "prediction": np.full((1, 2, 2), 0.11)}
    rows["prediction"][..., 0] = 0.89
    here = dataclasses.replace(falling, rows=rows, periodic=(True, False))
    np.testing.assert_allclose(here.errors()["prediction"], 0.02)


@given(frames=st.integers(1, 60), count=st.integers(1, 60))
def test_spread_frames_are_distinct_and_hold_both_ends(frames, count):
    exhibit = Exhibit({"a": np.full((frames, 1, 2), 0.5)}, np.array(["water"]), bounds=((0, 1), (0, 1)), dt=1.0)
    picked = exhibit.spread(count)
    assert picked == sorted(set(picked))
    assert len(picked) == min(frames, count)
    assert picked[0] == 0
    if count > 1:
        assert picked[-1] == frames - 1


def test_a_scene_gives_the_box_and_the_names(falling):
    scene = Scene(
        bounds=((0.1, 0.9),) * 2,
        domain=((0.08, 0.92),) * 2,
        dt=0.0025,
        materials=("sand", "goop"),
        particle_volume=1e-4,
        boundary=("periodic", "wall"),
        gravity=(0.0, -9.81),
    )
    exhibit = Exhibit.of_scene(scene, falling.rows, np.array([1, 0]))
    assert exhibit.material.tolist() == ["goop", "sand"]
    assert exhibit.walls == scene.domain
    assert exhibit.periodic == (True, False)
    assert exhibit.gravity == scene.gravity


def test_type_ids_become_names():
    assert material_names([6, 5, 6], {5: "water", 6: "sand"}).tolist() == ["sand", "water", "sand"]
    assert material_names([1, 0], ["water", "sand"]).tolist() == ["sand", "water"]


def test_a_type_id_without_a_name_is_named():
    with pytest.raises(DataError, match=r"type 9 .*5 water"):
        material_names([5, 9], {5: "water"})
