"""Recorded training steps, on a machine without a GPU with a stand-in for the recorder that runs the step again."""

import copy
import dataclasses
import pickle
import warnings
from contextlib import nullcontext

import pytest
import torch

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator.engines import graphs
from nmpm.training import EmulatorModule, module
from nmpm.transfer import without_kernels
from tests.trainings import TINY, module_of, train


@pytest.fixture
def replays(monkeypatch, device):
    """A list with an entry for each replay; on a CPU the recorder runs the step again, in place."""

    def record(function, *_):
        mean, gradients = function()

        def replay():
            again, slopes = function()
            mean.copy_(again)
            torch._foreach_copy_(gradients, slopes)

        return replay, (mean, gradients)

    def counting(function, *arguments):
        replay, result = recorder(function, *arguments)
        return (lambda: (counted.append(result[0].shape), replay())), result

    counted = []
    recorder = graphs.record if device.type == "cuda" else record
    monkeypatch.setattr(graphs, "record", counting)
    monkeypatch.setattr(module, "can_record", lambda _: True)
    monkeypatch.setattr(module, "MULTIPLE", 1)  # padding changes the order of sums, and which noise is whose
    monkeypatch.setattr(EmulatorModule, "rows", lambda _, batch: [slice(len(batch.frames))])  # as on a GPU
    with without_kernels() if device.type == "cpu" else nullcontext():  # those of a CPU read where the recipe's grid is
        yield counted


@pytest.fixture
def folder(make_dataset):
    return make_dataset(train=((12, 5), (12, 30), (12, 3), (12, 9)), statics=3)


@pytest.fixture
def step(folder, device):
    """Makes a module, and batches that are alike."""

    def make(**options) -> tuple[EmulatorModule, list]:
        data = TrajectoryDataModule(path=str(folder), horizon=4, batch_size=8, buffer_size=4, passes=2)
        made = module_of(data, processor=TINY, **options).train().to(device)
        made.log = lambda *_, **__: None
        batches = iter(data.train_dataloader())
        return made, [next(batches).to(device) for _ in range(3)]

    return make


def gradients(made: EmulatorModule, batch, precision: torch.dtype | None = None) -> list[torch.Tensor]:
    """The loss and the gradients of a training step."""
    made.zero_grad()
    torch.manual_seed(1)
    with torch.autocast(batch.frames.device.type, precision, enabled=precision is not None):
        loss = made.training_step(batch, 0)
    loss.backward()
    return [loss.detach(), *(weight.grad.clone() for weight in made.parameters())]


def assert_same(some: list[torch.Tensor], others: list[torch.Tensor], device: torch.device) -> None:
    """To the bit on a CPU; on a GPU sums are in no fixed order."""
    for one, other in zip(some, others, strict=True):
        exact = {"rtol": 0, "atol": 0} if device.type == "cpu" else {"rtol": 1e-3, "atol": 1e-5}
        torch.testing.assert_close(one, other, **exact)


@pytest.mark.parametrize("precision", [None, torch.bfloat16])
def test_replayed_steps_have_the_error_and_gradients_of_eager_ones(step, replays, device, precision):
    made, batches = step(position_noise=1e-3, grid_noise=0.0, mirror=(0,), record=True)
    eager, _ = step(position_noise=1e-3, grid_noise=0.0, mirror=(0,))
    for batch in (*batches, batches[0]):
        assert_same(gradients(made, batch, precision), gradients(eager, batch, precision), device)
        with torch.no_grad():  # as an optimizer does
            for one, other in zip(made.parameters(), eager.parameters(), strict=True):
                other.sub_(0.1 * other.grad)
                one.copy_(other)
    assert len(replays) == 4


def test_the_grid_moves_in_replays_as_it_does_without(step, replays):
    made, batches = step(jitter=0.2, record=True)
    eager, _ = step(jitter=0.2)
    errors = []
    for batch in batches:
        for one, other in zip(gradients(made, batch), gradients(eager, batch), strict=True):
            torch.testing.assert_close(one, other, rtol=2e-3, atol=1e-4 * float(other.abs().max()))
        torch.manual_seed(2)
        errors.append(made.training_step(batch, 0).item() - gradients(made, batch)[0].item())
    assert min(map(abs, errors)) > 0  # another seed moves it elsewhere
    assert len(replays) == 9


def test_the_noise_of_members_is_drawn_in_replays_as_it_is_without(step, replays, device):
    made, batches = step(members=2, record=True)
    eager, _ = step(members=2)
    for batch in batches:
        assert_same(gradients(made, batch), gradients(eager, batch), device)
    processor, channels = made.emulator.processor, len(made.emulator.scene.input_channels)
    first = processor.get_parameter(f"{processor.channel_layers.first}.weight")
    assert float(first.grad[:, channels : channels + processor.noise].abs().max()) > 0
    assert len(replays) == 3


def test_batches_of_several_sizes_share_a_graph_by_padding(step, replays, monkeypatch):
    monkeypatch.setattr(module, "MULTIPLE", 16)
    quiet = {"position_noise": 0.0, "grid_noise": 0.0}
    made, batches = step(record=True, **quiet)
    eager, _ = step(**quiet)
    for batch in (batches[0], batches[0].scenes([0, 1, 2])):
        for one, other in zip(gradients(made, batch), gradients(eager, batch), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4 * float(other.abs().max()))
    sizes = [30, 20, 32, 17]
    for size in sizes:
        gradients(made, dataclasses.replace(batches[0], **{
            name: getattr(batches[0], name)[..., :size, :] if name == "frames" else getattr(batches[0], name)[:, :size]
            for name in ("frames", "material", "mask")
        }))  # fmt: skip
    assert len(made._recorded._steps) == 2  # of two batch sizes


def test_a_training_is_the_same_recorded_resumed_and_eager(folder, replays, tmp_path, device):
    def losses(name: str, record: bool, steps: int = 6, start=None) -> list[float]:
        options = {"model": {"record": record, "jitter": 0.0}, "max_steps": steps, "ckpt_path": start, "soap": True}
        return train(folder, tmp_path / f"{name}.ckpt", **options)["losses"]

    if device.type != "cpu":
        pytest.skip("compares bits, which a GPU does not repeat")
    eager = losses("eager", record=False)
    assert replays == []
    assert losses("recorded", record=True) == eager
    losses("half", record=True, steps=3)
    assert losses("resumed", record=True, start=tmp_path / "half.ckpt") == eager[3:]
    assert len(replays) == 12


def test_a_step_that_cannot_be_recorded_is_said_once_and_training_goes_on(step, replays, device, monkeypatch):
    made, batches = step(record=True)
    eager, _ = step()
    plain = EmulatorModule._mean_error

    def reading(self, *arguments):
        mean = plain(self, *arguments)
        if self is made and not made._recorded._failed:
            mean.item()  # a recording cannot read back
            if device.type == "cpu":
                raise RuntimeError("operation not permitted\nwhen a stream is capturing")
        return mean

    monkeypatch.setattr(EmulatorModule, "_mean_error", reading)
    with pytest.warns(UserWarning, match="Training steps are not recorded as CUDA graphs"):
        first = gradients(made, batches[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        second = gradients(made, batches[1])
    assert replays == []
    assert_same(first + second, gradients(eager, batches[0]) + gradients(eager, batches[1]), device)


def test_copies_record_their_own_and_shapes_beyond_the_most_are_computed_eagerly(step, replays, monkeypatch):
    made, batches = step(record=True)
    monkeypatch.setattr("nmpm.training.recorded_steps._MOST", 1)
    gradients(made, batches[0])
    for other in (copy.deepcopy(made._recorded), pickle.loads(pickle.dumps(made._recorded))):  # noqa: S301
        assert other._steps == {}
    gradients(made, batches[0].scenes(slice(3)))
    assert len(replays) == 1
