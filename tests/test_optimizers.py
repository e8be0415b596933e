"""SOAP, which the shipped configurations train with."""

from functools import partial

import pytest
import torch

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


def test_complex_weights_are_refused_with_what_takes_them():
    with pytest.raises(ConfigError, match=r"complex.*torch\.optim\.Adam"):
        SOAP([torch.nn.Parameter(torch.zeros(2, 2, dtype=torch.complex64))])
