"""Cells and strides by which a model takes foreign data."""

import dataclasses
from fractions import Fraction
from itertools import permutations, product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, cloud, emulator_of

from nmpm.emulator import EmulatorRecipe, differentiable_rollout, rollout
from nmpm.emulator.adaptation import with_members, with_noise
from nmpm.emulator.model import UNLIMITED
from nmpm.emulator.similarity import find_match
from nmpm.errors import ConfigError
from nmpm.processors import UNet
from nmpm.scene import Motion, Turn


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


@pytest.mark.parametrize("frames", [Fraction(1, 3), Fraction(1), Fraction(2)], ids=str)
def test_a_fine_tuned_model_takes_its_data_as_in_its_training(frames):
    emulator, motion = model_of(), Motion(0.1, 0.2)
    scene = in_other_units(emulator.scene, materials=("gel",), domain=((-6.0, 259.0), (-12.0, 250.0)))
    tuned = emulator.matched(find_match(emulator, scene, motion, stride=frames))
    again = find_match(tuned, scene, motion)
    assert again.recipe == tuned.recipe
    assert Fraction(again.reading.every, again.reading.between) == frames
    estimated = dataclasses.replace(scene, particle_volume=1.03 * scene.particle_volume)
    assert find_match(tuned, estimated, motion).recipe.scene.domain == tuned.scene.domain


def test_a_model_that_is_told_gravity_keeps_its_cells_where_it_knows_the_gravity():
    emulator = model_of(box(gravity=None, gravity_varies=True))
    usual = find_match(emulator, box(gravity=(0.0, -9.81)))
    assert (usual.recipe.cells, usual.recipe.scene.gravity) == (emulator.recipe.cells, (0.0, -9.81))
    for other in (box(gravity=(0.0, -9.81e6)), box(gravity=(0.0, -9.81), particle_volume=box().particle_volume / 9)):
        assert find_match(emulator, other).recipe.cells != emulator.recipe.cells


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


def test_a_matched_model_knows_the_names_of_its_data_and_a_user_may_say_otherwise():
    emulator = model_of(box(materials=("water", "sand")))
    foreign = box(materials=("type1", "water"))
    tuned = emulator.matched(find_match(emulator, foreign, materials={"type1": "sand", "water": "sand"}))
    assert EmulatorRecipe.from_dict(tuned.recipe.to_dict()) == tuned.recipe
    assert find_match(tuned, foreign).reading.materials == {"type1": "sand", "water": "sand"}
    assert find_match(tuned, box(materials=("type1",))).reading.materials == {"type1": "sand"}
    again = find_match(tuned, foreign, materials={"water": "water"})
    assert again.reading.materials == {"type1": "sand"}
    assert again.recipe.scene.aliases == (("type1", "sand"),)
    with pytest.raises(ConfigError, match="aliases: 'sand' is none of the materials"):
        box(materials=("water",), aliases=(("type1", "sand"),))


def test_without_gravity_speeds_decide():
    emulator = model_of(box(gravity=None))
    scene = in_other_units(emulator.scene, time=1.0)
    rms = 0.05 * (2 / 0.2) ** 0.5  # where there is material
    width = 250 * emulator.grid.spacing[0]
    match = find_match(emulator, scene, Motion(rms * width / 2, rms * width))
    assert match.reading.every == 2
    assert not match.warnings
    assert "by speeds" in match.lines[2]


def test_the_model_jumps_over_no_more_frames_than_leave_enough_of_a_trajectory():
    emulator = model_of(box(gravity=None))
    scene = in_other_units(emulator.scene)
    width, bundle = 250 * emulator.grid.spacing[0], emulator.frames
    slow = {frames: Motion(1e-3 * width, 2e-3 * width, frames=frames) for frames in (3, 2 * bundle + 3, 1000)}
    every = [find_match(emulator, scene, motion).reading.every for motion in slow.values()]
    assert every == [1, 2, 20]


def test_a_rougher_match_is_a_warning_with_its_factor_and_strictly_refused():
    emulator = model_of()
    scene = in_other_units(emulator.scene, gravity=(0.0, -0.8), boundary=("open", "open"))
    match = find_match(emulator, scene, stride=Fraction(1), names=("goop", "slime"))
    gravity, boundary = match.warnings
    assert "slime is 0.0" in gravity
    assert "times that of goop" in gravity
    assert boundary == "Along x, y slime has the boundary 'open', goop was trained with 'wall'."
    with pytest.raises(ConfigError, match="times that of goop"):
        find_match(emulator, scene, stride=Fraction(1), strict=True, names=("goop", "slime"))


@pytest.mark.parametrize(
    ("change", "motion", "warning"),
    [
        ({"gravity": None}, Motion(), "Gravity of the data is not known"),
        ({"gravity": (0.0, 0.0)}, Motion(), "has no gravity, but the model learnt to fall"),
        ({"gravity": None, "gravity_varies": True}, Motion(), "Gravity differs between the scenes"),
        ({"gravity": (6.0 * 250 / 1600, 8.0 * 250 / 1600)}, Motion(), "points along"),
        ({"obstacles": True, "moving_obstacles": True}, Motion(), "moving obstacles"),
        ({}, Motion(1.0, 100.0), "times those that the model is calibrated for"),
    ],
    ids=["unknown", "none", "differing", "oblique", "moving", "fast"],
)
def test_warnings_name_what_differs(change, motion, warning):
    emulator = model_of()
    match = find_match(emulator, in_other_units(emulator.scene, **change), motion)
    assert any(warning in each for each in match.warnings)
    assert emulator.matched(match).recipe == match.recipe


def test_gravity_that_is_not_stated_is_taken_as_measured():
    emulator = model_of()
    scene = in_other_units(emulator.scene)
    match = find_match(emulator, dataclasses.replace(scene, gravity=None), Motion(1.0, 2.0, gravity=scene.gravity))
    assert match.recipe.scene.gravity == scene.gravity
    assert "as measured" in match.lines[2]
    assert not match.warnings


def test_walls_begin_with_the_models_share_of_a_cell_and_cells_are_whole():
    emulator = model_of(box(bounds=((0.1, 0.9), (0.1, 0.9)), domain=((0.09, 0.93), (0.09, 0.93))))
    scene = in_other_units(emulator.scene, bounds=((0.0, 317.0), (-4.0, 90.0)), domain=((-9.0, 320.0), (-9.0, 99.0)))
    recipe = find_match(emulator, scene).recipe
    (low, high), (first, last), h = recipe.scene.bounds[0], recipe.scene.domain[0], recipe.grid.spacing[0]
    assert (low - first) / h == pytest.approx(0.01 / emulator.grid.spacing[0])
    assert (last - high) / h >= 0.03 / emulator.grid.spacing[0] - 1e-3
    assert recipe.grid.spacing[1] == pytest.approx(h)
    assert h == pytest.approx(250 * emulator.grid.spacing[0], rel=0.1)


def test_periods_are_whole_cells_of_a_number_that_the_network_takes():
    emulator = model_of(box(boundary=("periodic", "wall"), domain=((0.1, 0.9), (0.08, 0.92))), cells=(16, 24))
    scene = in_other_units(emulator.scene, bounds=((0.0, 230.0), (0.0, 77.0)), domain=((0.0, 230.0), (-5.0, 80.0)))
    match = find_match(emulator, scene)
    assert match.recipe.cells[0] % 2 == 0
    assert match.recipe.scene.domain[0] == (0.0, 230.0)


def test_cells_keep_the_ratio_of_their_sides():
    emulator = model_of(cells=(24, 20))
    recipe = find_match(emulator, in_other_units(emulator.scene)).recipe
    assert recipe.cells == (24, 20)


def test_a_model_that_is_told_gravity_takes_any_up_to_its_own():
    emulator = knowing_gravity()
    sideways = in_other_units(box(), gravity=(0.8 * 9.81 * 250 / 1600, 0.0))
    match = find_match(emulator, sideways)
    assert not match.warnings
    assert match.recipe.scene.gravity_varies
    assert match.recipe.scene.gravity == sideways.gravity
    assert match.recipe.grid.spacing[0] == pytest.approx(250 * emulator.grid.spacing[0], rel=0.1)


def test_a_model_of_many_particle_sizes_takes_them_all():
    recipe = dataclasses.replace(model_of().recipe, particles_per_cell=(1.0, 9.0))
    assert type(recipe).from_dict(recipe.to_dict()) == recipe
    emulator = model_of()
    emulator.recipe = recipe
    for spacings in (1.1, 2.9):
        width = 250 * emulator.grid.spacing[0]
        match = find_match(emulator, in_other_units(emulator.scene, particle_volume=(width / spacings) ** 2))
        assert not match.warnings
        assert float(match.lines[2].split()[-1]) == pytest.approx(1, abs=0.05)
    with pytest.raises(ConfigError, match="the fewest, then the most"):
        dataclasses.replace(recipe, particles_per_cell=(9.0, 1.0))


def test_obstacles_and_walls_keep_or_add_the_solid_channel():
    walled, bare = model_of(), model_of(box(domain=((0.1, 0.9), (0.1, 0.9))))
    open_sky = in_other_units(walled.scene, boundary=("open", "open"))
    assert find_match(walled, open_sky).recipe.scene.input_channels == walled.scene.input_channels
    rocks = find_match(bare, in_other_units(bare.scene, obstacles=True))
    assert "solid" in rocks.recipe.scene.input_channels
    assert "does not see" in rocks.warnings[0]
    assert bare.matched(rocks).input_mean.shape[0] == bare.input_mean.shape[0] + 1


def test_what_cannot_be_is_refused():
    emulator = model_of()
    with pytest.raises(ConfigError, match="2 axes"):
        find_match(emulator, box(3))
    with pytest.raises(ConfigError, match="stride = 2/3"):
        find_match(emulator, box(), stride=Fraction(2, 3))
    vast = in_other_units(emulator.scene, bounds=((0.0, 1e6), (0.0, 1e6)), domain=((-9.0, 1.1e6), (-9.0, 1.1e6)))
    with pytest.raises(ConfigError, match=r"more than 4,000,000.*wide for particles"):
        find_match(emulator, vast)


def test_the_box_ends_at_a_block_of_the_coarsest_cells_as_in_training():
    emulator = emulator_of(box(gravity=(0.0, -10.0)), cells=32, processor=UNet(width=4, depth=3, perceptron=(4,)))
    model = emulator.scene
    wide = dataclasses.replace(
        model, bounds=tuple((100 * low, 130 * high) for low, high in model.bounds),
        domain=tuple((100 * low, 130 * high) for low, high in model.domain),
        particle_volume=model.particle_volume * 100**2, gravity=(0.0, -1000.0),
    )  # fmt: skip
    assert all(cells % 8 == 0 for cells in find_match(emulator, wide).recipe.cells)


def test_a_box_of_fewer_cells_than_the_models_gets_finer_ones():
    emulator = model_of()
    scene = in_other_units(emulator.scene)
    small = dataclasses.replace(scene, bounds=((0.0, 60.0), (0.0, 60.0)), domain=((-2.0, 62.0), (-2.0, 62.0)))
    width = find_match(emulator, small).recipe.grid.spacing[0]
    assert 0.7 < width / (250 * emulator.grid.spacing[0]) < 0.98


TURNS = [
    Turn(tuple(map("".join, zip(signs, order, strict=True))))
    for axes in ("xy", "xyz")
    for order in permutations(axes)
    for signs in product(("", "-"), repeat=len(axes))
]


def along(vectors, turn):
    """Vectors (..., D) in the axes that a turn makes of theirs."""
    return vectors[..., list(turn.sources)] * torch.tensor([-1.0 if mirror else 1.0 for mirror in turn.mirrored])


def in_unit(scene, unit):
    """The scene in a unit of length, of which so many are one of its own."""
    return in_other_units(scene, unit, 1.0, (0.0,) * scene.dim)


def knowing_gravity():
    """A model of scenes whose gravity differs, up to that of `box()`."""
    emulator = model_of(box(gravity=None, gravity_varies=True))
    strongest = 9.82 * 0.0025**2 / emulator.grid.spacing[0]
    emulator.input_mean[-2:], emulator.input_std[-2:] = 0.0, strongest / 2
    emulator.input_low[-2:], emulator.input_high[-2:] = -2 * strongest, 2 * strongest
    return emulator


@given(unit=st.floats(1e-4, 1e4), varies=st.booleans())
@settings(max_examples=10, deadline=None)
def test_a_scene_of_the_model_has_its_cells_in_any_unit(unit, varies):
    emulator = knowing_gravity() if varies else model_of()
    emulator.recipe = dataclasses.replace(emulator.recipe, particles_per_cell=(1.0, 9.0))
    scene = in_unit(box(), unit)
    assert find_match(emulator, scene, stride=Fraction(1)).recipe.cells == emulator.recipe.cells


@given(unit=st.sampled_from([1e-6, 1e-3, 1e-2, 10.0, 1e3, 1e6]), spacing=st.floats(0.5, 1.5), wider=st.integers(1, 4))
@settings(max_examples=6, deadline=None)
def test_a_scene_has_as_many_cells_in_micrometres_as_in_metres(unit, spacing, wider):
    emulator, h = knowing_gravity(), 0.84 / 24
    scene = box(
        domain=((0.08, 0.92 + wider * h), (0.08, 0.92)), bounds=((0.1, 0.9 + wider * h), (0.1, 0.9)),
        particle_volume=(0.02 * spacing) ** 2,
    )  # fmt: skip
    expected = find_match(emulator, scene, stride=Fraction(1))
    assert find_match(emulator, in_unit(scene, unit), stride=Fraction(1)).recipe.cells == expected.recipe.cells


def in_axes(state, turn):
    names = ("position", "velocity", "obstacle", "obstacle_velocity", "gravity")
    return dataclasses.replace(state, **{name: along(getattr(state, name), turn) for name in names})


def oblong(dim=2, **changes):
    """A scene with sides that differ, a floor thinner than the ceiling, and obstacles that move."""
    bounds = ((0.1, 0.9), (0.15, 0.85), (0.2, 0.9))[:dim]
    gravity = (0.0, -9.81, 0.0)[:dim]
    facts = {"bounds": bounds, "domain": ((0.08, 0.92),) * dim, "gravity": gravity, "boundary": ("wall",) * dim}
    return box(dim, ("water", "sand"), **(facts | {"obstacles": True, "moving_obstacles": True} | changes))


def moving(scene, **changes):
    state = cloud(scene, statics=6, count=40)
    return dataclasses.replace(state, obstacle_velocity=torch.full_like(state.obstacle, 1e-3), **changes)


@pytest.mark.parametrize("turn", TURNS, ids=lambda turn: "".join(turn.axes))
@torch.no_grad()
def test_data_whose_gravity_points_elsewhere_are_predicted_as_data_that_are_turned_by_hand(turn):
    scene = oblong(len(turn.axes))
    emulator, state, data = model_of(scene, cells=12), in_axes(moving(scene), turn), scene.turned(turn)
    match = find_match(emulator, data, stride=Fraction(1))
    assert not match.warnings
    assert (len(match.lines) == 6) == (not match.recipe.turn.is_identity)
    found = match.recipe.turn
    assert found.vector(data.gravity) == scene.gravity
    by_hand = emulator.matched(find_match(emulator, data.turned(found), stride=Fraction(1)))
    assert by_hand.recipe.turn.is_identity
    expected = rollout(by_hand, in_axes(state, found), 9)
    predicted = rollout(emulator.matched(match), state, 9)
    torch.testing.assert_close(along(predicted, found), expected, rtol=0, atol=2e-6)


def test_a_match_says_which_axis_is_which():
    emulator, turn = model_of(oblong(3), cells=12), Turn(("x", "z", "-y"))
    match = find_match(emulator, emulator.scene.turned(turn))
    assert match.lines[4] == "axes       -z of the data is y of the model, y of the data is z of the model"
    assert match.recipe.scene.bounds == emulator.scene.turned(turn).bounds


def test_periodic_axes_are_those_of_the_model():
    scene = oblong(3, boundary=("periodic", "wall", "wall"), domain=((0.1, 0.9), (0.08, 0.92), (0.08, 0.92)))
    swapped = Turn(("z", "y", "x"))
    assert find_match(model_of(scene, cells=(12, 12, 12)), scene.turned(swapped)).recipe.turn == swapped


def test_gravity_between_the_axes_is_left_as_it_is():
    emulator = model_of(oblong())
    match = find_match(emulator, oblong(gravity=(6.0, -7.0)))
    assert match.recipe.turn.is_identity
    assert any("between its axes" in warning for warning in match.warnings)


def test_gradients_flow_through_turned_axes():
    emulator, turn = model_of(oblong()).requires_grad_(False), Turn(("y", "x"))
    turned = emulator.matched(find_match(emulator, emulator.scene.turned(turn)))
    gradients = []
    for model, state in ((emulator, moving(emulator.scene)), (turned, in_axes(moving(emulator.scene), turn))):
        velocity = state.velocity.clone().requires_grad_()
        differentiable_rollout(model, dataclasses.replace(state, velocity=velocity), 6).square().sum().backward()
        gradients.append(velocity.grad)
    torch.testing.assert_close(gradients[1].flip(-1), gradients[0])


@pytest.mark.parametrize("steady", [True, False])
def test_a_model_of_gravities_that_vary_turns_data_only_where_their_direction_did_not(steady):
    emulator = model_of(oblong(gravity=None, gravity_varies=True))
    size = 9.81 * 0.0025**2 / emulator.grid.spacing[0]
    emulator.input_mean[-2:], emulator.input_std[-2:] = 0.0, size
    if steady:
        emulator.input_mean[-1], emulator.input_std[-1], emulator.input_std[-2] = -size, size / 3, 1.0
        emulator.input_low[-2], emulator.input_high[-2] = -UNLIMITED, UNLIMITED
    match = find_match(emulator, oblong(gravity=(9.81, 0.0)))
    assert match.recipe.turn.axes == (("y", "-x") if steady else ("x", "y"))


def test_turned_models_are_stored_matched_again_and_given_noise():
    emulator, turn = model_of(oblong()), Turn(("-y", "x"))
    turned = emulator.matched(find_match(emulator, emulator.scene.turned(turn)))
    stored = EmulatorRecipe.from_dict(turned.recipe.to_dict()).build().eval()
    stored.load_state_dict(turned.state_dict())
    state = in_axes(moving(emulator.scene), turn)
    for other in (stored, with_noise(turned), turned.matched(find_match(turned, turned.scene))):
        assert torch.equal(rollout(other, state, 6), rollout(turned, state, 6))
    back = turned.matched(find_match(turned, emulator.scene))
    assert back.recipe == emulator.recipe
    assert torch.equal(rollout(back, moving(emulator.scene), 6), rollout(emulator, moving(emulator.scene), 6))
    assert with_members(turned.recipe, 2) == with_noise(turned).recipe


def test_a_turned_model_takes_added_channels_as_the_model_does():
    emulator = model_of(box(materials=("water", "sand")))
    turn = find_match(emulator, emulator.scene.turned(Turn(("y", "x")))).recipe.turn
    data = dataclasses.replace(emulator.scene, obstacles=True, moving_obstacles=True, materials=("a", "b"))
    mapped = {"a": "water", "b": "sand"}
    plain = emulator.matched(find_match(emulator, data, materials=mapped))
    turned = emulator.matched(find_match(emulator, data.turned(turn.inverse), materials=mapped))
    state = moving(data)
    expected = along(rollout(plain, state, 6), turn.inverse)
    torch.testing.assert_close(rollout(turned, in_axes(state, turn.inverse), 6), expected, rtol=0, atol=2e-6)
