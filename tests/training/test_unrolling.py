from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator import unroll
from nmpm.emulator.rollouts import recomputed
from nmpm.errors import ConfigError
from nmpm.particles import Window
from nmpm.processors import UNet
from nmpm.training import EmulatorModule
from nmpm.training.unrolling import Discount, direct, unroll_training

BUNDLES = 3


@pytest.fixture
def window(make_dataset):
    data = TrajectoryDataModule(path=str(make_dataset(train=((12, 40), (12, 50)))), horizon=2 * BUNDLES, batch_size=2)
    data.setup("fit")
    return next(iter(data.train_dataloader())), data.scene


def module_of(scene, **options) -> EmulatorModule:
    torch.manual_seed(0)
    small = UNet(width=4, depth=1, perceptron=(4,))
    return EmulatorModule(scene, cells=8, frames=2, unroll=BUNDLES, processor=small, **options)


def gradient(module: EmulatorModule, window: Window) -> torch.Tensor:
    """That of a training step, of all weights in a row."""
    module.log = lambda *_, **__: None
    module.training_step(window, 0).backward()
    return torch.cat([weight.grad.reshape(-1) for weight in module.parameters()]).double()


def test_gradients_are_a_polynomial_of_the_discount(window):
    """What the j-th later bundle says of a bundle comes back multiplied by factor^j."""
    batch, scene = window
    factors = torch.tensor([0.0, 0.25, 0.5, 1.0], dtype=torch.float64)
    found = torch.stack([gradient(module_of(scene, gradient_discount=float(f)), batch) for f in factors])
    powers = factors[:, None] ** torch.arange(BUNDLES)
    parts = torch.linalg.solve(powers[:BUNDLES], found[:BUNDLES])
    scale = found[-1].abs().max()
    assert (powers[-1] @ parts - found[-1]).abs().max() < 1e-4 * scale
    for one, other in pairwise(found):
        assert (one - other).abs().max() > 1e-3 * scale  # bundles do depend on those before


def test_without_a_discount_gradients_are_those_of_plain_backpropagation_to_the_bit(window):
    batch, scene = window
    module = module_of(scene)
    bundles = list(unroll(module.emulator.train(), batch.initial, BUNDLES))
    predicted = torch.cat([bundle.position for bundle in bundles], dim=1)
    error = module.error(predicted, batch, module.emulator.scene, module.emulator.grid, module.emulator.frames)
    plain = torch.autograd.grad(error, list(module.parameters()))
    found = gradient(module_of(scene, gradient_discount=1.0), batch)
    assert torch.equal(found, torch.cat([slope.reshape(-1) for slope in plain]).double())


def test_predictions_do_not_depend_on_the_discount(window):
    batch, scene = window
    emulator = module_of(scene).emulator.train()

    def positions(call, discount: Discount) -> torch.Tensor:
        bundles = unroll_training(emulator, batch.initial, BUNDLES, call, discount)
        return torch.cat([bundle.position for bundle in bundles], dim=1)

    plain = positions(direct, Discount())
    assert torch.equal(plain, positions(direct, Discount(0.5)))
    assert torch.equal(plain, positions(recomputed, Discount(0.0)))


def test_recomputed_gradients_are_discounted_likewise(window):
    batch, scene = window
    kept, saved = (module_of(scene, gradient_discount=0.5, recompute=recompute) for recompute in (False, True))
    assert torch.equal(gradient(kept, batch), gradient(saved, batch))


def test_cut_gradients_are_not_computed_at_all(window):
    batch, _ = window
    state = batch.initial.with_motion(batch.initial.position.clone().requires_grad_(), batch.initial.velocity)
    assert not Discount(0.0)(state).position.requires_grad
    assert Discount(0.5)(state).position.requires_grad


@given(factor=st.one_of(st.floats(max_value=0, exclude_max=True), st.floats(min_value=1, exclude_min=True)))
@settings(max_examples=20, deadline=None)
def test_a_discount_outside_of_its_range_is_refused(factor):
    with pytest.raises(ConfigError, match=r"model\.gradient_discount = .* must be in \[0, 1\]"):
        Discount(factor)
