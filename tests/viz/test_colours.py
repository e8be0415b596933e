import itertools
import string

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nmpm.viz.colours import INTERIOR, MATERIALS, OBSTACLE, SPARE, colour, palette, shaded

TOGETHER = ["water", "sand", "goop", "elastic", "rigid", "boundary"]

# Machado, Oliveira & Fernandes 2009, severity 1, on linear RGB.
SIGHT = {
    "full": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}


def lab(rgb, sight):
    """CIELAB of an sRGB colour as that sight sees it (D65)."""
    value = np.array(rgb) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    linear = np.clip(SIGHT[sight] @ linear, 0, 1)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(to_xyz @ linear / to_xyz.sum(axis=1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("sight", SIGHT)
def test_materials_stay_apart_from_each_other_and_from_the_ground(sight):
    shown = {name: colour(name) for name in TOGETHER} | {"ground": INTERIOR}
    for one, other in itertools.combinations(shown, 2):
        distance = np.linalg.norm(lab(shown[one], sight) - lab(shown[other], sight))
        assert distance > 15, (one, other)


def test_what_cannot_move_is_grey():
    assert colour("boundary") == colour("wall") == OBSTACLE
    assert max(OBSTACLE) - min(OBSTACLE) < 20


@given(st.text(string.ascii_lowercase, min_size=1))
def test_any_name_has_a_stable_colour(name):
    assert colour(name) == colour(name)
    assert colour(name) in {*MATERIALS.values(), *SPARE}


def test_unknown_names_have_the_same_colour_in_every_run():
    assert colour("debris") == SPARE[4]


@given(st.lists(st.text(string.ascii_lowercase, min_size=1), unique=True, max_size=len(SPARE)))
def test_unknown_materials_of_one_scene_differ(names):
    unknown = [name for name in names if name not in MATERIALS]
    assert len({palette(unknown)[name] for name in unknown}) == len(unknown)


def test_a_palette_keeps_the_given_order():
    assert list(palette(["sand", "xyz", "water", "sand"])) == ["sand", "xyz", "water"]


def test_shading_varies_a_little_around_the_colour():
    plain = np.tile(np.array(colour("water"), dtype=np.uint8), (200, 1))
    tones = shaded(plain)
    assert tuple(tones[0]) == colour("water")
    assert 1 < len(np.unique(tones, axis=0)) < 8
    assert np.abs(tones.astype(int) - plain).max() < 45
