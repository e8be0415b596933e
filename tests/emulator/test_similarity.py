"""Cells and strides by which a model takes foreign data."""

import dataclasses
from fractions import Fraction

import pytest
import torch
from scenes import box, cloud, emulator_of

from nmpm.emulator import rollout
from nmpm.emulator.similarity import find_match
from nmpm.errors import ConfigError
from nmpm.processors import UNet
from nmpm.scene import Motion


def model_of(scene=None, cells=24, **statistics):
    """A calibrated emulator with random weights."""
    emulator = emulator_of(scene or box(), cells, frames=3, processor=UNet(4, 1), scale=0.01)
    emulator.input_std.fill_(0.05)
    emulator.input_mean[-2 if emulator.scene.walled else -1] = 0.2  # the volume fraction
    emulator.input_low.fill_(-0.6)
    emulator.input_high.fill_(0.6)
    emulator.calibrated.fill_(True)
    return emulator


def in_other_units(scene, length=250.0, time=40.0, origin=(3.0, -7.0), **changes):
    """The scene in units of which so many are one of its own, with another origin."""

    def interval(ends, shift):
        return tuple(length * end + shift for end in ends)

    gravity = scene.gravity and tuple(length / time**2 * g for g in scene.gravity)
    facts = {
        "bounds": tuple(map(interval, scene.bounds, origin)),
        "domain": tuple(map(interval, scene.domain, origin)),
        "dt": scene.dt * time,
        "particle_volume": scene.particle_volume * length**scene.dim,
        "gravity": gravity,
    }
    return dataclasses.replace(scene, **(facts | changes))


def test_a_scene_of_the_model_keeps_its_recipe():
    emulator = model_of()
    match = find_match(emulator, emulator.scene)
    assert match.recipe == emulator.recipe
    assert not match.warnings
    assert (match.reading.scene, match.reading.materials) == (emulator.scene, {})
    assert (match.reading.every, match.reading.between) == (1, 1)


def test_a_model_that_is_told_gravity_keeps_its_cells_where_it_knows_the_gravity():
    emulator = model_of(box(gravity=None, gravity_varies=True))
    usual = find_match(emulator, box(gravity=(0.0, -9.81)))
    assert (usual.recipe.cells, usual.recipe.scene.gravity) == (emulator.recipe.cells, (0.0, -9.81))
    assert find_match(emulator, box(gravity=(0.0, -9.81e6))).recipe.cells != emulator.recipe.cells


@pytest.mark.parametrize("scene", [box(), box(domain=((0.05, 0.95), (0.0, 0.92)))], ids=["even", "uneven"])
def test_in_other_units_with_other_names_a_rollout_is_the_same(scene):
    emulator = model_of(scene)
    other = in_other_units(scene, materials=("Goop",))
    match = find_match(emulator, other)
    assert not match.warnings
    assert match.recipe.cells == emulator.recipe.cells
    assert match.reading.materials == {"Goop": "goop"}
    state = cloud(scene)
    origin = torch.tensor([3.0, -7.0])
    foreign = dataclasses.replace(
        state,
        position=state.position * 250 + origin,
        velocity=state.velocity * 250,
        gravity=state.gravity * 250,
    )
    expected = rollout(emulator, state, 9) * 250 + origin
    torch.testing.assert_close(rollout(emulator.matched(match), foreign, 9), expected, rtol=0, atol=250 * 1e-5)


@pytest.mark.parametrize("frames", [2, 5, Fraction(1, 2), Fraction(1, 4)])
def test_the_stride_makes_up_for_frames_that_are_further_apart_or_closer(frames):
    emulator = model_of()
    scene = in_other_units(emulator.scene)
    match = find_match(emulator, dataclasses.replace(scene, dt=scene.dt / float(frames)))
    assert Fraction(match.reading.every, match.reading.between) == frames
    assert match.recipe.scene.dt == pytest.approx(scene.dt)
    assert not match.warnings
    assert match.recipe.cells == emulator.recipe.cells


def test_materials_are_told_by_their_names_or_asked_for():
    emulator = model_of(box(materials=("water", "sand")))
    scene = box(materials=("Wet grains", "fluid"))
    match = find_match(emulator, scene)
    assert match.reading.materials == {"Wet grains": "sand", "fluid": "water"}
    assert "proposed" in match.lines[-1]
    with pytest.raises(ConfigError, match=r"mud, sand; the model has water, sand.*--materials mud=water,sand=sand"):
        find_match(emulator, box(materials=("mud", "sand")))
    match = find_match(emulator, box(materials=("mud", "sand")), materials={"mud": "sand"})
    assert match.reading.scene.materials == ("water", "sand")
    with pytest.raises(ConfigError, match="'snad'"):
        find_match(emulator, scene, materials={"fluid": "snad"})


def test_without_gravity_speeds_decide():
    emulator = model_of(box(gravity=None))
    scene = in_other_units(emulator.scene, time=1.0)
    rms = 0.05 * (2 / 0.2) ** 0.5  # where there is material
    width = 250 * emulator.grid.spacing[0]
    match = find_match(emulator, scene, Motion(rms * width / 2, rms * width))
    assert match.reading.every == 2
    assert not match.warnings
    assert "by speeds" in match.lines[2]
