"""Batches in parts: the same error and gradients as in one, and the same bits by any number of threads."""

from types import SimpleNamespace

import pytest
import torch

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.decoders import Residual
from nmpm.emulator.constraints import Constraints
from nmpm.processors import FNO, UNet
from nmpm.training import EmulatorModule
from nmpm.training.callbacks.threads import Threads
from nmpm.training.parts import mean_over_parts, split_rows
from nmpm.transfer import Linear


@pytest.mark.parametrize(("count", "parts", "sizes"), [(8, 2, [4, 4]), (7, 3, [2, 2, 3]), (2, 4, [1, 1]), (1, 2, [1])])
def test_rows_are_shared_evenly(count, parts, sizes):
    rows = split_rows(count, parts)
    assert [len(range(count)[part]) for part in rows] == sizes
    assert [row for part in rows for row in range(count)[part]] == list(range(count))


@pytest.fixture
def step(make_dataset):
    """Makes a module and a batch of windows of 3 to 30 particles."""
    folder = make_dataset(train=((12, 5), (12, 30), (12, 3), (12, 9)))

    def make(processor, **options):
        data = TrajectoryDataModule(path=str(folder), horizon=4, batch_size=7, buffer_size=4)
        torch.manual_seed(0)
        module = EmulatorModule(
            data.scene, cells=8, frames=2, unroll=2, processor=processor, transfer=Linear(), decoder=Residual(),
            constraints=Constraints(energy=True), **options,
        )  # fmt: skip
        module.log = lambda *_, **__: None
        return module.train(), next(iter(data.train_dataloader()))

    return make


def gradients(module, batch, parts, threads, precision=None):
    module.parts, module.threads = parts, threads
    module.zero_grad()
    torch.manual_seed(1)
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == torch.bfloat16):
        loss = module.training_step(batch, 0)
    loss.backward()
    return [loss.detach(), *(weight.grad.clone() for weight in module.parameters())]


@pytest.mark.parametrize("recompute", [False, True])
@pytest.mark.parametrize(
    "processor", [UNet(width=4, depth=1, perceptron=(4,)), FNO(width=4, modes=2, layers=1)], ids=str
)
def test_parts_have_the_error_and_the_gradients_of_the_whole(step, processor, recompute):
    module, batch = step(processor, recompute=recompute, position_noise=1e-3, jitter=0.1, mirror=(0,))
    whole = gradients(module, batch, 1, 1)
    for parts in (2, 3):
        for mine, other in zip(gradients(module, batch, parts, parts), whole, strict=True):
            torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-5 * float(other.abs().max()))


@pytest.mark.parametrize("precision", [None, torch.bfloat16])
def test_the_number_of_threads_changes_no_bit(step, precision):
    module, batch = step(UNet(width=4, depth=1, perceptron=(4,)))
    one = gradients(module, batch, 3, 1, precision)
    for threads in (2, 3, 3, 3):
        assert all(map(torch.equal, gradients(module, batch, 3, threads, precision), one))


def test_rollouts_in_parts_are_those_of_the_whole(step):
    module, batch = step(UNet(width=4, depth=1, perceptron=(4,)))
    module.eval()
    module.parts = 1
    whole = module.predict_step(batch, 0)
    module.parts = 3
    torch.testing.assert_close(module.predict_step(batch, 0), whole, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("stated", "stored", "parts"), [(2, 3, 2), (None, 3, 3), (None, 0, 1)])
def test_a_resumed_training_keeps_its_parts_unless_threads_are_stated_or_a_gpu_had_none(
    step, monkeypatch, stated, stored, parts
):
    monkeypatch.setattr("nmpm._support.threads.usable_cores", lambda: 1)
    module, _ = step(UNet(width=4, depth=1, perceptron=(4,)))
    trainer = SimpleNamespace(strategy=SimpleNamespace(root_device=torch.device("cpu")), world_size=1, num_nodes=1)
    callback = Threads(stated)
    callback.setup(trainer, module, "fit")
    callback.load_state_dict({"parts": stored})
    assert callback.state_dict() == {"parts": parts}
    assert module.parts == parts


def test_an_error_in_a_thread_is_raised(step):
    module, batch = step(UNet(width=4, depth=1, perceptron=(4,)))
    threads = torch.get_num_threads()
    with pytest.raises(ZeroDivisionError):
        mean_over_parts(lambda _: 1 / 0, batch.mask, split_rows(7, 2), module.parameters(), 2)
    assert torch.get_num_threads() == threads


def test_noise_on_the_grid_is_drawn_for_all_windows_together(step):
    module, batch = step(UNet(width=4, depth=1, perceptron=(4,)), grid_noise=0.1)
    module.parts = 3
    assert module.rows(batch) == [slice(0, 7)]
