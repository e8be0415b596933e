"""An emulator in a recipe of other channels predicts what it did before, to the bit where shapes allow."""

import dataclasses
from functools import cache

import pytest
import torch

from nmpm._support.shipped import shipped_folder
from nmpm.emulator.adaptation import adapted
from nmpm.emulator.calibration import calibrate_unread, unread_inputs
from nmpm.errors import ConfigError
from nmpm.processors import Identity, Patched, Pointwise, UNet
from nmpm.transfer import without_kernels
from nmpm.zoo import Zoo
from tests.scenes import box, cloud, emulator_of, window_of

SHIPPED = shipped_folder("zoo")
GRAVITY = {"gravity_varies": True, "gravity": None}
MORE = {
    "obstacles": {"obstacles": True},
    "moving obstacles": {"obstacles": True, "moving_obstacles": True},
    "gravity": GRAVITY,
    "a first material": lambda scene: {"materials": ("snow", *scene.materials), "densities": ()},
    "a last material": lambda scene: {"materials": (*scene.materials, "snow"), "densities": ()},
    "fields": {"evolving": ("heat",), "properties": ("size",), "parameters": ("angle",)},
}


@cache
def of_zoo(name):
    model = Zoo.load(name, SHIPPED)
    return model.emulator, model.example(count=200)


def over(emulator, change):
    change = change(emulator.scene) if callable(change) else change
    scene = dataclasses.replace(emulator.scene, **change)
    limits = emulator.constraints
    limits = dataclasses.replace(limits, energy=limits.energy and scene.is_closed)
    return adapted(emulator, dataclasses.replace(emulator.recipe, scene=scene, constraints=limits))


def frames(emulator, state, names):
    """(B, m, N, D) the next positions of particles whose materials are indices into these names."""
    index = torch.tensor([emulator.scene.materials.index(name) for name in names])
    with torch.no_grad():
        return emulator(dataclasses.replace(state, material=index[state.material])).position


@pytest.mark.filterwarnings("ignore:The scene has no")
@pytest.mark.parametrize("more", MORE)
@pytest.mark.parametrize("name", Zoo.list(SHIPPED))
def test_every_shipped_model_predicts_the_same_with_more_channels(name, more):
    emulator, state = of_zoo(name)
    other, names = over(emulator, MORE[more]), emulator.scene.materials
    before = emulator.with_constraints(other.constraints)
    with without_kernels():
        assert torch.equal(frames(other, state, names), frames(before, state, names))
    if other.engine_forms:
        assert torch.equal(frames(other, state, names), frames(before, state, names))


def test_trainings_begin_with_the_same_predictions_and_reach_the_added_weights():
    emulator = emulator_of(box(), processor=UNet(width=4, depth=1, perceptron=(4,)))
    other = over(emulator, {"materials": ("goop", "sand"), **GRAVITY})
    state = cloud(emulator.scene)
    after = other.train()(state).position
    assert torch.equal(after, emulator.train()(state).position)
    mixed = dataclasses.replace(state, material=torch.arange(30)[None] % 2)
    other(mixed).position.square().sum().backward()
    first, last = other.processor.encoder[0].weight.grad, other.processor.decoders[2][-1].weight.grad
    gravity = other.scene.input_channels.index("gravity_y")
    assert first[:, gravity].any()
    assert last.any()


def test_added_materials_move_as_the_decoder_alone_says():
    emulator = emulator_of(box(), processor=UNet(width=4, depth=1, perceptron=(4,)))
    other = over(emulator, {"materials": ("sand", "goop")})
    state = cloud(other.scene, seed=1)
    still = dataclasses.replace(state, velocity=0 * state.velocity, material=0 * state.material)
    moved = other(still).position.diff(dim=1)
    acceleration = emulator.scene.gravity[1] * emulator.scene.dt**2
    assert (moved[..., 1] - acceleration * torch.arange(2, 5)[:, None]).abs().max() < 1e-6


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("multimaterial", {"materials": ("goop",), "densities": ()}),
        ("multimaterial", {"materials": ("goop", "water"), "densities": ()}),
        ("variablegravity", {"gravity_varies": False, "gravity": (0.3, -4.0)}),
    ],
    ids=["one material", "two materials", "gravity"],
)
def test_dropped_channels_are_the_constant_that_they_have_where_nothing_is(name, change):
    emulator, state = of_zoo(name)
    other = over(emulator, change)
    kept = other.scene.materials
    if other.scene.gravity:
        state = dataclasses.replace(state, gravity=torch.tensor([other.scene.gravity]) * other.scene.dt**2)
    state = dataclasses.replace(state, material=0 * state.material)
    before = emulator.with_constraints(other.constraints)
    torch.testing.assert_close(frames(other, state, kept[:1]), frames(before, state, kept[:1]), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "processor",
    [UNet(width=4, depth=1, perceptron=(4,)), Patched(UNet(width=4, depth=1, perceptron=(4,))), Pointwise()],
)
def test_there_and_back_gives_the_same_emulator(processor):
    emulator = emulator_of(box(materials=("a", "b")), processor=processor)
    emulator.input_std.copy_(torch.rand_like(emulator.input_std) + 0.5)
    emulator.output_scale.copy_(torch.rand_like(emulator.output_scale))
    there = over(emulator, {"materials": ("c", "b", "a"), **GRAVITY, "evolving": ("heat",)})
    back = adapted(there, emulator.recipe).state_dict()
    assert all(torch.equal(values, back[name]) for name, values in emulator.state_dict().items())
    assert back.keys() == emulator.state_dict().keys()


def test_added_inputs_are_not_clipped_and_have_a_spread_like_others():
    emulator, _ = of_zoo("goop")
    other = over(emulator, {"materials": ("goop", "sand"), **GRAVITY, "obstacles": True, "moving_obstacles": True})
    std = dict(zip(other.scene.input_channels, other.input_std.flatten().tolist(), strict=True))
    assert std["sand.velocity_y"] == std["solid.velocity_y"] == std["goop.velocity_y"]
    assert std["sand.volume"] == std["goop.volume"]
    fall = 9.81 * other.scene.dt**2 / other.grid.spacing[1]
    assert std["gravity_x"] == pytest.approx(fall / 2**0.5)
    state = torch.full((1, len(std), *other.grid.shape), 3.0)
    added = [i for i, name in enumerate(other.scene.input_channels) if name not in emulator.scene.input_channels]
    assert (other.normalise(state) * other.input_std)[:, added].eq(3.0).all()


def test_statistics_of_added_channels_come_from_the_data_and_predictions_stay():
    emulator = emulator_of(box(), processor=UNet(width=4, depth=1, perceptron=(4,)))
    emulator.calibrated.fill_(True)
    other = over(emulator, {"materials": ("goop", "sand"), **GRAVITY, "evolving": ("heat",), "parameters": ("angle",)})
    names = other.scene.input_channels
    assert [names[i] for i in unread_inputs(other)] == [
        name for name in names if name not in emulator.scene.input_channels
    ]
    state = dataclasses.replace(cloud(emulator.scene, batch=2), gravity=torch.tensor([[0.0, -6e-5], [6e-5, 0.0]]))
    heat, angle = 300 + 10 * torch.arange(30.0).view(1, 1, 30), torch.tensor([[[20.0]], [[40.0]]])
    window = window_of(state, state.position[:, None] + 0.001 * torch.arange(6.0).view(1, 6, 1, 1))
    window = dataclasses.replace(window, fields={"heat": heat.expand(2, 1, 30), "angle": angle})
    before, stds = frames(other, window.initial, ["goop"]), other.input_std.clone()
    calibrate_unread(other, [window])
    assert torch.equal(frames(other, window.initial, ["goop"]), before)
    assert [name for name, old, new in zip(names, stds, other.input_std, strict=True) if old != new] == [
        "gravity_x",
        "gravity_y",
        "goop.heat",
        "angle",
    ]
    assert other.input_std[names.index("gravity_y")].item() == pytest.approx(
        6e-5 / other.grid.spacing[1] / 2**0.5, rel=1e-3
    )
    assert not other.input_mean[names.index("gravity_y")]
    torch.testing.assert_close(other.field_scales.mean, torch.tensor([445.0, 30.0]))
    torch.testing.assert_close(other.field_scales.std, torch.tensor([heat.std(correction=0).item(), 10.0]))


def test_other_networks_are_refused():
    emulator = emulator_of(box(), processor=Identity())
    with pytest.raises(ConfigError, match=r"Identity cannot be given other channels \(\+gravity_x \+gravity_y\)"):
        over(emulator, GRAVITY)
    with pytest.raises(ConfigError, match="weights are for frames = 4, not 2"):
        adapted(emulator, dataclasses.replace(emulator.recipe, frames=2))
