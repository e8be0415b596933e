"""Fields that particles carry: channels, rates, statistics, and scenes with more or fewer than the model."""

import dataclasses

import pytest
import torch

from nmpm.emulator import EmulatorRecipe, predict_rollout
from nmpm.emulator.calibration import calibrate
from nmpm.emulator.rasterise import grid_state
from nmpm.errors import ConfigError
from nmpm.processors import UNet
from nmpm.scene import Scene
from nmpm.transfer import Affine, Linear, Nearest, Quadratic
from nmpm.zoo.export.parts import Step
from tests.scenes import box, cloud, emulator_of, padded, silenced, window_of

ALL = {"evolving": ("temperature",), "properties": ("stiffness",), "parameters": ("friction",)}


def small(scene, transfer=Linear()):
    return emulator_of(scene, frames=3, transfer=transfer, processor=UNet(width=4, depth=1, perceptron=(4,)))


def constant_rate(emulator, rate):
    """The emulator with a network that says zero for velocities and one number for the rates of fields."""
    flows = torch.arange(len(emulator.scene.output_channels)) < emulator.scene.dim * len(emulator.scene.materials)
    rates = torch.where(flows, 0.0, rate).view(-1, 1, 1)
    silenced(emulator).processor.register_forward_hook(lambda _, __, output: output + rates)
    return emulator


def with_fields(particles):
    generator = torch.Generator().manual_seed(0)
    temperature, stiffness = torch.rand(2, *particles.mask.shape, generator=generator)
    friction = torch.rand(len(stiffness), 1, generator=generator)
    return particles.with_fields({"temperature": 1 + 0.1 * temperature, "stiffness": stiffness, "friction": friction})


def test_the_channels_follow_from_the_fields():
    scene = box(2, ("water", "sand"), **ALL)
    assert scene.input_channels[-5:] == (
        "water.temperature", "water.stiffness", "sand.temperature", "sand.stiffness", "friction",
    )  # fmt: skip
    assert scene.output_channels[-2:] == ("water.temperature", "sand.temperature")
    assert scene.input_channels[:-5] == box(2, ("water", "sand")).input_channels
    assert Scene.from_dict(scene.to_dict()) == scene
    assert not {"evolving", "properties", "parameters"} & set(box().to_dict())
    assert not [name for name in small(box()).state_dict() if "field" in name]


@pytest.mark.parametrize("transfer", [Nearest(), Linear(), Quadratic(), Affine()])
def test_a_field_that_is_the_same_everywhere_is_so_on_the_grid_and_stays_so(transfer):
    scene = box(2, ("water", "sand"), evolving=("temperature",))
    emulator, particles = constant_rate(small(scene, transfer), 0.0), cloud(scene, speed=0.005)
    particles = particles.with_fields({"temperature": torch.full(particles.mask.shape, 1.25)})
    cells, velocity, _ = emulator.in_cells(particles)
    solid = emulator.solid(particles)
    state = grid_state(scene, emulator.grid, transfer, particles, cells, velocity, solid, emulator.field_scales)
    for index, material in enumerate(scene.materials):
        occupied = state[:, scene.input_channels.index(f"{material}.volume")] > 0
        channel = state[:, -2 + index]
        torch.testing.assert_close(channel[occupied], torch.full_like(channel[occupied], 1.25))
        assert (channel[~occupied] == 0).all()
    assert (predict_rollout(emulator, particles, 20).fields["temperature"] == 1.25).all()


def test_a_uniform_rate_adds_up_over_frames_and_bundles():
    scene = box(evolving=("temperature",))
    emulator, particles = constant_rate(small(scene), 0.5), with_fields(cloud(scene))
    emulator.field_scales.std.fill_(0.1)
    predicted = predict_rollout(emulator, particles, 7).fields["temperature"]
    steps = 0.05 * torch.arange(1, 8).view(1, -1, 1)
    torch.testing.assert_close(predicted, particles.fields["temperature"].unsqueeze(1) + steps)


@pytest.mark.parametrize("filler", [1e30, float("nan")])
def test_padded_particles_change_no_field_to_the_bit(filler):
    scene = box(**ALL)
    emulator, particles = small(scene), with_fields(cloud(scene, count=20))
    more = padded(particles, torch.full((7, 2), 0.5), field=filler)
    one, other = (predict_rollout(emulator, state, 7) for state in (particles, more))
    assert torch.equal(one.position, other.position[:, :, :20])
    assert torch.equal(one.fields["temperature"], other.fields["temperature"][..., :20])


def test_a_missing_field_has_its_training_mean_and_is_named():
    scene = box(**ALL)
    emulator, particles = small(scene), with_fields(cloud(scene))
    emulator.field_scales.mean.copy_(torch.tensor([1.05, 0.4, 0.3]))
    means = dict(zip(("temperature", "stiffness", "friction"), (1.05, 0.4, 0.3), strict=True))
    means = {name: torch.full_like(particles.fields[name], value) for name, value in means.items()}
    with pytest.warns(UserWarning, match="has no stiffness.*training mean, 0.4,"):
        predicted = predict_rollout(emulator, dataclasses.replace(particles, fields={}), 5)
    expected = predict_rollout(emulator, particles.with_fields(means), 5)
    torch.testing.assert_close(predicted.position, expected.position)
    torch.testing.assert_close(predicted.fields["temperature"], expected.fields["temperature"])


def test_calibration_measures_fields_over_real_particles_and_scenes():
    scene = box(**ALL)
    state, rise = cloud(scene, count=8, batch=2), torch.arange(6.0).view(1, 6, 1).expand(2, 6, 8)
    state.mask[1, 4:] = False
    temperature = 1 + 0.01 * rise
    temperature[1, :, 4:] = 1e6
    friction, stiffness = torch.tensor([1.0, 3.0]).view(2, 1, 1), torch.full((2, 1, 8), 7.0)
    window = window_of(state, state.position.unsqueeze(1) + 0.001 * rise.unsqueeze(-1))
    window.fields = {"temperature": temperature, "stiffness": stiffness, "friction": friction}
    emulator = small(scene)
    calibrate(emulator, [window])
    levels, scales = 1 + 0.01 * torch.arange(6.0), emulator.field_scales
    torch.testing.assert_close(scales.mean, torch.tensor([float(levels.mean()), 7.0, 2.0]))
    torch.testing.assert_close(scales.std, torch.tensor([float(levels.std(correction=0)), 1.0, 1.0]))
    rate = 0.01 / levels.std(correction=0)
    torch.testing.assert_close(emulator.output_scale[:, -1].flatten(), rate.expand(3))


def test_other_scenes_keep_the_models_fields_and_exports_refuse_them():
    emulator = small(box(**ALL))
    assert emulator.over(box(bounds=((0.1, 0.9),) * 2)).scene.fields == emulator.scene.fields
    assert EmulatorRecipe.from_dict(emulator.recipe.to_dict()).scene == emulator.scene
    with pytest.raises(ConfigError, match="exported files do not carry: fields: use it in Python, or train one"):
        Step(emulator)
