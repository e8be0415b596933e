"""Every processor in an emulator, in two and three dimensions, through a training step as Lightning makes it."""

import pytest
import torch
from scenes import box, cloud

from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.rollouts import rollout, unroll
from nmpm.processors import FFNO, FNO, TFNO, Axial, ConvNeXt, Identity, Pointwise, UNet, UNetModern

SMALL = [
    UNet(width=4, depth=2, perceptron=(5,)),
    UNetModern(width=4, growth=(1, 2, 3)),
    ConvNeXt(width=6, depth=2, kernel=5),
    FNO(modes=4, width=6, layers=2),
    TFNO(modes=4, width=6, layers=2, rank=0.5),
    FFNO(modes=4, width=6, layers=2),
    Axial(width=16, layers=2, heads=2, patch=4),
    Pointwise(hidden=(6,)),
    Identity(),
]


@pytest.mark.parametrize("processor", SMALL, ids=lambda recipe: type(recipe).__name__)
@pytest.mark.parametrize(("dim", "cells", "periodic"), [(2, 16, False), (3, [8, 8, 4], True)])
def test_trains_and_rolls_out(processor, dim, cells, periodic):
    boundary = ("periodic",) + ("wall",) * (dim - 1) if periodic else ()
    changes = {"domain": ((0.1, 0.9),) + ((0.08, 0.92),) * (dim - 1)} if periodic else {}
    scene = box(dim, ("water", "sand"), boundary=boundary, obstacles=True, **changes)
    particles = cloud(scene, batch=2, statics=5)
    torch.manual_seed(0)
    emulator = EmulatorRecipe(scene, cells, frames=2, processor=processor).build()
    with torch.autocast("cpu", torch.bfloat16):
        predicted = torch.cat([bundle.position for bundle in unroll(emulator, particles, 2)], dim=1)
    assert predicted.shape == (2, 4, 30, dim)
    if any(True for _ in emulator.parameters()):
        (predicted - 0.5).square().mean().backward()
        gradients = [p.grad for p in emulator.parameters() if p.grad is not None]
        assert gradients
        assert all(gradient.isfinite().all() for gradient in gradients)
    assert rollout(emulator.eval(), particles, 5).isfinite().all()
