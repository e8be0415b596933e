"""SOAP, which the shipped configurations train with."""

import copy
from functools import partial

import pytest
import pytorch_optimizer
import torch

from nmpm import optimizers
from nmpm.emulator.engines import graphs
from nmpm.errors import ConfigError
from nmpm.optimizers import SOAP


def loss_after(steps: int, make) -> float:
    """Of a quadratic in a matrix, stretched by up to 30 along axes that are not the matrix's own, on either side."""
    generator = torch.Generator().manual_seed(0)
    target, *mixed = (torch.randn(12, 12, generator=generator) for _ in range(3))
    left, right = (torch.linalg.qr(m).Q @ torch.diag(torch.logspace(0, 1.5, 12)) for m in mixed)
    weight = torch.nn.Parameter(torch.zeros(12, 12))
    optimizer = make([weight])
    for _ in range(steps):
        optimizer.zero_grad()
        loss = (left.T @ (weight - target) @ right).square().mean()
        loss.backward()
        optimizer.step()
    return loss.item()


def test_it_finds_the_axes_along_which_a_problem_is_stretched():
    soap = loss_after(300, partial(SOAP, lr=0.03, weight_decay=0.0))
    adam = min(loss_after(300, partial(torch.optim.Adam, lr=rate)) for rate in (0.01, 0.03, 0.1))
    assert soap < 0.1 * adam


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_steps_are_those_of_the_plain_algorithm(device, layout):
    """Weights of one shape are computed together, the axes of a kernel as one."""
    generator = torch.Generator().manual_seed(0)
    shapes = ((6, 5, 3, 2), (6, 5, 3, 2), (4,), (4,), (5, 7), (), (3, 9, 1, 1), (2, 3, 2, 2, 3))

    def make(kind):
        generator.manual_seed(1)
        weights = [torch.nn.Parameter(torch.randn(shape, generator=generator).to(device)) for shape in shapes]
        for weight in weights:
            weight.data = weight.data.contiguous(memory_format=layout) if weight.dim() == 4 else weight.data
        return weights, kind(weights, lr=0.01, weight_decay=0.1, max_precondition_dim=8, precondition_frequency=3)

    (ours, together), (theirs, plain) = make(SOAP), make(pytorch_optimizer.SOAP)
    for step in range(11):
        for one, other in zip(ours, theirs, strict=True):
            one.grad = torch.randn(one.shape, generator=generator).to(device)
            one.grad, other.grad = torch.empty_like(one).copy_(one.grad), one.grad.clone()
        if step == 6:
            ours[2].grad = theirs[2].grad = None
        together.step()
        plain.step()
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_complex_weights_are_refused_with_what_takes_them():
    with pytest.raises(ConfigError, match=r"complex.*torch\.optim\.Adam"):
        SOAP([torch.nn.Parameter(torch.zeros(2, 2, dtype=torch.complex64))])


@pytest.mark.parametrize("frequency", [1, 4])
def test_recorded_steps_move_weights_as_others_do(monkeypatch, device, frequency):
    def train(resume_at: int) -> list[torch.Tensor]:
        generator = torch.Generator().manual_seed(0)
        shapes = ((4, 3, 3, 3), (4,), (5, 7))
        weights = [torch.nn.Parameter(torch.randn(shape, generator=generator).to(device)) for shape in shapes]
        optimizer = SOAP(weights, lr=0.01, precondition_frequency=frequency, record=True)
        for step in range(14):
            if step == resume_at:
                state = copy.deepcopy(optimizer.state_dict())
                optimizer = SOAP(weights, lr=0.5, precondition_frequency=frequency, record=True)
                optimizer.load_state_dict(state)
            for weight in weights:
                weight.grad = torch.randn(weight.shape, generator=generator).to(device)
            optimizer.param_groups[0]["lr"] = 0.01 * (1 - step / 14)
            optimizer.step()
        return [weight.detach() for weight in weights]

    replays = []

    def record(function, *arguments):
        for _ in range(3 if device.type == "cpu" else 0):
            function()
        replay, result = (function, None) if device.type == "cpu" else on_gpu(function, *arguments)
        return (lambda: (replays.append(1), replay())), result

    on_gpu = graphs.record
    monkeypatch.setattr(optimizers, "is_on_gpu", lambda _: False)
    plain = train(resume_at=20)
    monkeypatch.setattr(optimizers, "is_on_gpu", lambda _: True)
    monkeypatch.setattr(graphs, "record", record)
    for resume_at in (20, 7):
        for one, other in zip(train(resume_at), plain, strict=True):
            exact = {"rtol": 0, "atol": 0} if device.type == "cpu" else {"rtol": 1e-4, "atol": 1e-5}
            torch.testing.assert_close(one, other, **exact)
    assert len(replays) == (0 if frequency == 1 else 26)


def test_steps_that_cannot_be_recorded_are_computed_with_one_warning(monkeypatch):
    weight = torch.nn.Parameter(torch.ones(3, 3))
    optimizer = SOAP([weight], record=True)
    monkeypatch.setattr(optimizers, "is_on_gpu", lambda _: True)
    monkeypatch.setattr(graphs, "record", lambda *_: 1 / 0)
    weight.grad = torch.eye(3)
    optimizer.step()
    with pytest.warns(UserWarning, match="Steps of SOAP are not recorded as CUDA graphs: division by zero"):
        optimizer.step()
    moved = weight[0, 0].item()
    optimizer.step()
    assert weight[0, 0].item() < moved < 1
    copy.deepcopy(optimizer).step()  # without gradients
