"""Gradients of a training step: discounted, recomputed, and in parts by any number of threads to the same bits."""

from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator import Emulator, Rollout, unroll
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.rollouts import recomputed, unroll_with_gradients
from nmpm.errors import ConfigError
from nmpm.processors import FNO
from nmpm.training import EmulatorModule
from nmpm.training.backpropagation import CastNetworks, discount_gradients, mean_over_parts, split_rows
from nmpm.training.callbacks.threads import Threads
from tests.trainings import TINY

BUNDLES = 3


@pytest.fixture
def step(make_dataset):
    """Makes a module and a batch of windows of 3 to 30 particles."""
    folder = make_dataset(train=((12, 5), (12, 30), (12, 3), (12, 9)))

    def make(processor=TINY, **options):
        data = TrajectoryDataModule(path=str(folder), horizon=2 * BUNDLES, batch_size=7, buffer_size=4)
        torch.manual_seed(0)
        given = {"cells": 8, "frames": 2, "unroll": BUNDLES, "processor": processor, **options}
        module = EmulatorModule(data.scene, constraints=Constraints(energy=True), **given)
        module.log = lambda *_, **__: None
        return module.train(), next(iter(data.train_dataloader()))

    return make


def gradients(module, batch, parts=1, threads=1, precision=None) -> list[torch.Tensor]:
    """The loss and the gradients of a training step."""
    module.parts, module.threads = parts, threads
    module.zero_grad()
    torch.manual_seed(1)
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == torch.bfloat16):
        loss = module.training_step(batch, 0)
    loss.backward()
    return [loss.detach(), *(weight.grad.clone() for weight in module.parameters())]


def gradient(module, batch) -> torch.Tensor:
    """The gradient of a training step with respect to all weights in a row."""
    return torch.cat([slope.reshape(-1) for slope in gradients(module, batch)[1:]]).double()


def test_gradients_are_a_polynomial_of_the_discount(step):
    """The gradient from the j-th later bundle is multiplied by factor^j."""
    factors = torch.tensor([0.0, 0.25, 0.5, 1.0], dtype=torch.float64)
    discounted = torch.stack([gradient(*step(gradient_discount=float(factor))) for factor in factors])
    powers = factors[:, None] ** torch.arange(BUNDLES)
    parts = torch.linalg.solve(powers[:BUNDLES], discounted[:BUNDLES])
    scale = discounted[-1].abs().max()
    assert (powers[-1] @ parts - discounted[-1]).abs().max() < 1e-4 * scale
    for one, other in pairwise(discounted):
        assert (one - other).abs().max() > 1e-3 * scale  # bundles do depend on those before


def test_without_a_discount_gradients_are_those_of_plain_backpropagation_to_the_bit(step):
    module, batch = step(gradient_discount=1.0)
    bundles = list(unroll(module.emulator, batch.initial, BUNDLES))
    predicted = torch.cat([bundle.position for bundle in bundles], dim=1)
    error = module.loss(Rollout(predicted, {}), batch, module.emulator)
    plain = torch.autograd.grad(error, list(module.parameters()))
    assert torch.equal(gradient(module, batch), torch.cat([slope.reshape(-1) for slope in plain]).double())


def test_predictions_do_not_depend_on_the_discount(step):
    module, batch = step()

    def positions(call, factor: float) -> torch.Tensor:
        def state_after(bundle, start):
            return discount_gradients(bundle.state_after(start), factor)

        bundles = unroll_with_gradients(module.emulator, batch.initial, BUNDLES, call, state_after)
        return torch.cat([bundle.position for bundle in bundles], dim=1)

    plain = positions(Emulator.__call__, 1.0)
    assert torch.equal(plain, positions(Emulator.__call__, 0.5))
    assert torch.equal(plain, positions(recomputed, 0.0))
    state = batch.initial.with_motion(batch.initial.position.clone().requires_grad_(), batch.initial.velocity)
    assert not discount_gradients(state, 0.0).position.requires_grad  # cut gradients are not computed at all
    with pytest.raises(ConfigError, match=r"model\.gradient_discount = 1\.1 must be in \[0, 1\]"):
        step(gradient_discount=1.1)


def test_recomputed_gradients_are_the_same_to_the_bit_for_less_memory(step):
    def measure(recompute: bool) -> tuple[torch.Tensor, int]:
        module, batch = step(recompute=recompute)
        kept = []
        with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t.numel()) or t, lambda tensor: tensor):
            slopes = gradient(module, batch)
        return slopes, sum(kept)

    (plain, held), (again, less) = measure(False), measure(True)
    assert torch.equal(plain, again)
    assert less < held


@pytest.mark.parametrize(("count", "parts", "sizes"), [(8, 2, [4, 4]), (7, 3, [2, 2, 3]), (2, 4, [1, 1]), (1, 2, [1])])
def test_rows_are_shared_evenly(count, parts, sizes):
    rows = split_rows(count, parts)
    assert [len(range(count)[part]) for part in rows] == sizes
    assert [row for part in rows for row in range(count)[part]] == list(range(count))


@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("recompute", [False, True])
@pytest.mark.parametrize("processor", [TINY, FNO(width=4, modes=2, layers=1)], ids=["unet", "fno"])
def test_parts_have_the_error_and_the_gradients_of_the_whole(step, processor, recompute, members):
    options = {"recompute": recompute, "position_noise": 1e-3, "jitter": 0.1, "mirror": (0,), "members": members}
    module, batch = step(processor, **options)
    whole = gradients(module, batch)
    for part, other in zip(gradients(module, batch, 3, 3), whole, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-4, atol=1e-5 * float(other.abs().max()))


@pytest.mark.parametrize("precision", [None, torch.bfloat16])
def test_the_number_of_threads_changes_no_bit(step, precision):
    module, batch = step()
    one = gradients(module, batch, 3, 1, precision)
    for threads in (2, 3, 3):
        assert all(map(torch.equal, gradients(module, batch, 3, threads, precision), one))


def test_weights_that_are_cast_once_have_the_error_and_the_gradients_of_autocast(step, monkeypatch):
    module, batch = step()
    frozen = next(module.parameters()).requires_grad_(False)
    module.parts, module.threads = 3, 3
    results = []
    for prepare in (CastNetworks.prepare, lambda _, emulator, __: lambda _: emulator):
        monkeypatch.setattr(CastNetworks, "prepare", prepare)
        module.zero_grad()
        torch.manual_seed(1)
        with torch.autocast("cpu", torch.bfloat16):
            loss = module.training_step(batch, 0)
        loss.backward()
        assert frozen.grad is None
        slopes = [weight.grad for weight in module.parameters() if weight.requires_grad]
        assert all(slope.dtype == torch.float32 for slope in slopes)
        results.append((loss.item(), torch.cat([slope.flatten() for slope in slopes])))
    (error, once), (same, plain) = results
    assert error == same
    assert (once - plain).norm() < 0.02 * plain.norm()


def test_rollouts_in_parts_are_those_of_the_whole(step):
    module, batch = step()
    module.eval()
    module.parts = 1
    whole = module.predict_step(batch, 0)
    module.parts = 3
    torch.testing.assert_close(module.predict_step(batch, 0), whole, rtol=1e-5, atol=1e-6)


def test_noise_on_the_grid_is_drawn_for_all_windows_together(step):
    module, batch = step(grid_noise=0.1)
    module.parts = 3
    assert module.rows(batch) == [slice(0, 7)]


def test_an_error_in_a_thread_is_raised(step):
    module, batch = step()
    threads = torch.get_num_threads()
    with pytest.raises(ZeroDivisionError):
        mean_over_parts(lambda *_: 1 / 0, batch.mask, split_rows(7, 2), module.emulator, CastNetworks(), 2)
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize(("stated", "stored", "parts"), [(2, 3, 2), (None, 3, 3), (None, 0, 1)])
def test_a_resumed_training_keeps_its_parts_unless_threads_are_stated_or_a_gpu_had_none(
    step, monkeypatch, stated, stored, parts
):
    monkeypatch.setattr("nmpm._support.threads.usable_cores", lambda: 1)
    module, _ = step()
    trainer = SimpleNamespace(strategy=SimpleNamespace(root_device=torch.device("cpu")), world_size=1, num_nodes=1)
    callback = Threads(stated)
    callback.setup(trainer, module, "fit")
    callback.load_state_dict({"parts": stored})
    assert callback.state_dict() == {"parts": parts}
    assert module.parts == parts
