import itertools
import string

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nmpm.viz.colours import (
    FALLBACK_COLOURS,
    INTERIOR,
    MATERIAL_COLOURS,
    OBSTACLE,
    material_colour,
    material_colours,
    vary_brightness,
)

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
    shown = {name: material_colour(name) for name in COMMON_MATERIALS} | {"background": INTERIOR}
    for one, other in itertools.combinations(shown, 2):
        distance = np.linalg.norm(lab(shown[one], vision) - lab(shown[other], vision))
        assert distance > 15, (one, other)


def test_static_materials_are_grey():
    assert material_colour("boundary") == material_colour("wall") == OBSTACLE
    assert max(OBSTACLE) - min(OBSTACLE) < 20


@given(st.text(string.ascii_lowercase, min_size=1))
def test_any_name_has_a_stable_colour(name):
    assert material_colour(name) == material_colour(name)
    assert material_colour(name) in {*MATERIAL_COLOURS.values(), *FALLBACK_COLOURS}


def test_unknown_names_have_the_same_colour_in_every_run():
    assert material_colour("debris") == FALLBACK_COLOURS[4]


@given(st.lists(st.text(string.ascii_lowercase, min_size=1), unique=True, max_size=len(FALLBACK_COLOURS)))
def test_unknown_materials_of_one_scene_differ(names):
    unknown = [name for name in names if name not in MATERIAL_COLOURS]
    assert len({material_colours(unknown)[name] for name in unknown}) == len(unknown)


def test_material_colours_keep_the_given_order():
    assert list(material_colours(["sand", "xyz", "water", "sand"])) == ["sand", "xyz", "water"]


def test_brightness_varies_a_little_around_the_colour():
    plain = np.tile(np.array(material_colour("water"), dtype=np.uint8), (200, 1))
    varied = vary_brightness(plain)
    assert tuple(varied[0]) == material_colour("water")
    assert 1 < len(np.unique(varied, axis=0)) < 8
    assert np.abs(varied.astype(int) - plain).max() < 45
