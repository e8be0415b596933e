"""Emulators whose network reads noise: step 0 is the deterministic model; seeds of scenes alone decide rollouts."""

import dataclasses

import pytest
import torch

from nmpm.emulator import RolloutOptions, predict_rollout
from nmpm.emulator.adaptation import adapted, with_noise
from nmpm.emulator.noise import Noise
from nmpm.errors import ConfigError
from nmpm.processors import FNO, Axial, ConvNeXt, GridLayout, Patched, Pointwise, Stochastic, UNet, UNetModern
from nmpm.transfer import without_kernels
from tests.scenes import box, cloud, emulator_of

PROCESSORS = [
    UNet(width=6, depth=1, perceptron=(5,)), FNO(modes=4, width=6, layers=2), UNetModern(width=4, growth=(1, 2)),
    ConvNeXt(width=6, depth=1, kernel=3), Axial(width=16, layers=1, heads=2, patch=4), Pointwise(),
    Patched(UNet(width=6, depth=1, perceptron=(5,))),
]  # fmt: skip


def noisy(emulator, size=0.3):
    """The emulator with weights of the noise that are not 0."""
    other = with_noise(emulator)
    first = other.processor.get_parameter(f"{other.processor.channel_layers.first}.weight")
    cells, noise = other.processor.channel_layers.cells, other.processor.noise
    channels = len(other.scene.input_channels)
    with torch.no_grad():
        first[:, channels * cells : (channels + noise) * cells] = size
    return other


@pytest.mark.parametrize("processor", PROCESSORS, ids=lambda processor: type(processor).__name__)
def test_noise_without_weights_changes_nothing(processor):
    state = cloud(box(), batch=2, count=40)
    emulator = emulator_of(box(), processor=processor)
    before = predict_rollout(emulator, state, 10).position
    other = with_noise(emulator)
    after = predict_rollout(other, state, 10, RolloutOptions(noise=Noise(other, [0, 1]))).position
    torch.testing.assert_close(after, before, rtol=1e-5, atol=1e-6)
    assert other.recipe.processor == Stochastic(processor)


def test_a_scene_depends_on_its_own_seed_alone():
    state = cloud(box(), batch=2, count=40)
    emulator = noisy(emulator_of(box(), processor=PROCESSORS[0]))
    both = predict_rollout(emulator, state, 20, RolloutOptions(noise=Noise(emulator, [5, 7]))).position
    alone = predict_rollout(emulator, state.scenes([1]), 20, RolloutOptions(noise=Noise(emulator, [7]))).position
    torch.testing.assert_close(both[1:], alone, rtol=1e-5, atol=1e-6)
    other = predict_rollout(emulator, state.scenes([1]), 20, RolloutOptions(noise=Noise(emulator, [8]))).position
    assert (other - alone).abs().max() > 1e-3
    without = predict_rollout(emulator, state.scenes([1]), 20).position
    assert torch.equal(without, predict_rollout(emulator, state.scenes([1]), 20).position)
    assert (without - alone).abs().max() > 1e-3


def test_kernels_and_tensors_read_the_same_noise():
    state = cloud(box(), batch=1, count=40)
    emulator = noisy(emulator_of(box(), processor=PROCESSORS[0]))
    by_kernels = predict_rollout(emulator, state, 8, RolloutOptions(noise=Noise(emulator, [3]))).position
    with without_kernels():
        by_tensors = predict_rollout(emulator, state, 8, RolloutOptions(noise=Noise(emulator, [3]))).position
    torch.testing.assert_close(by_kernels, by_tensors, rtol=1e-4, atol=1e-5)


def test_gathered_noise_keeps_its_variance_and_is_shared_within_blocks():
    network = Stochastic(UNet(width=6, depth=1, perceptron=(5,)), fine=1, coarse=1, block=4)
    network = network.build(GridLayout(3, 2, 1, (False, False)))
    noise = network._gathered(torch.randn(4, 200, 16, 24, generator=torch.Generator().manual_seed(0)))
    assert noise.std() == pytest.approx(1.0, rel=0.02)
    blocks = noise.unflatten(3, (-1, 4)).unflatten(2, (-1, 4))
    assert torch.equal(blocks, blocks[:, :, :, :1, :, :1].expand_as(blocks))


def test_a_recipe_with_noise_takes_the_weights_of_one_without():
    state = cloud(box(), batch=1, count=40)
    emulator = emulator_of(box(), processor=PROCESSORS[0])
    recipe = dataclasses.replace(emulator.recipe, processor=Stochastic(PROCESSORS[0], fine=3))
    other = adapted(emulator, recipe)
    assert other.processor.noise == 5
    before, after = (predict_rollout(one, state, 8).position for one in (emulator, other))
    torch.testing.assert_close(after, before, rtol=1e-5, atol=1e-6)
    with pytest.raises(ConfigError, match="weights are for processor"):
        adapted(other, emulator.recipe)


def test_noise_must_be_some():
    for wrong in ({"fine": 0, "coarse": 0}, {"fine": -1}, {"block": 0}, {"processor": Stochastic()}):
        with pytest.raises(ConfigError, match="noise"):
            Stochastic(**wrong)
