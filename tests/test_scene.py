import dataclasses

import pytest

from nmpm.errors import ConfigError
from nmpm.scene import Scene

BOX = Scene(
    bounds=((0.1, 0.9), (0.1, 0.9)),
    domain=((0.08, 0.92), (0.08, 0.92)),
    dt=0.0025,
    materials=("goop",),
    particle_volume=6e-5,
    gravity=(0.0, -9.81),
)


def test_a_box_of_one_material_needs_four_channels():
    assert BOX.input_channels == ("goop.velocity_x", "goop.velocity_y", "goop.volume", "solid")
    assert BOX.output_channels == ("goop.velocity_x", "goop.velocity_y")


def test_only_what_varies_becomes_a_channel():
    open_box = dataclasses.replace(BOX, domain=BOX.bounds)
    assert "solid" not in open_box.input_channels
    assert "solid" in dataclasses.replace(open_box, obstacles=True).input_channels
    assert "gravity_y" in dataclasses.replace(BOX, gravity_varies=True).input_channels
    mixed = dataclasses.replace(BOX, materials=("water", "sand"))
    assert len(mixed.input_channels) == 2 * 3 + 1
    assert mixed.output_channels == mixed.input_channels[:4]


def test_gravity_is_known_where_it_is_one_or_each_trajectory_has_its_own():
    assert BOX.gravity_known
    unknown = dataclasses.replace(BOX, gravity=None)
    assert not unknown.gravity_known
    assert dataclasses.replace(unknown, gravity_varies=True).gravity_known


def test_volume_is_that_of_the_bounds_and_spacing_that_of_a_lattice():
    scene = dataclasses.replace(BOX, particle_volume=0.01**2)
    assert scene.volume == pytest.approx(0.8**2)
    assert scene.particle_spacing == pytest.approx(0.01)


def test_survives_as_plain_data():
    channel = {"boundary": ("periodic", "wall"), "domain": ((0.1, 0.9), (0.08, 0.92))}
    scene = dataclasses.replace(BOX, **channel, obstacles=True)
    assert Scene.from_dict(scene.to_dict()) == scene
    assert "densities" not in scene.to_dict()  # as in files from before there were any
    weighed = dataclasses.replace(BOX, densities=(1000.0,))
    assert weighed.to_dict()["densities"] == [1000.0]
    assert Scene.from_dict(weighed.to_dict()) == weighed


def test_densities_change_neither_channels_nor_what_a_model_suits():
    weighed = dataclasses.replace(BOX, densities=(1000.0,))
    assert weighed.input_channels == BOX.input_channels
    assert weighed.differences(BOX) == ()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"domain": ((0.2, 0.92), (0.08, 0.92))}, "axis 0"),
        ({"dt": 0.0}, "dt"),
        ({"materials": ("goop", "goop")}, "once"),
        ({"boundary": ("wall", "mirror")}, "mirror"),
        ({"boundary": ("wall", "periodic")}, "Axis 1 is periodic.* must be the same, one period apart"),
        ({"particle_volume": float("nan")}, "particle_volume"),
        ({"densities": (1.0, 2.0)}, "densities"),
        ({"densities": (0.0,)}, "positive and finite"),
    ],
)
def test_contradictions_are_named(changes, complaint):
    with pytest.raises(ConfigError, match=complaint):
        dataclasses.replace(BOX, **changes)


def test_unknown_keys_are_named():
    with pytest.raises(ConfigError, match="colour"):
        Scene.from_dict(BOX.to_dict() | {"colour": "red"})
