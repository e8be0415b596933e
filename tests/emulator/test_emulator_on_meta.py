"""Training and rollouts on torch's `meta` device, a stand-in for a GPU on a machine without one.

Mixing it with the CPU raises, and so does reading a value back: neither must happen in a step or a bundle.
"""

from contextlib import nullcontext

import pytest
import torch
from scenes import box, cloud

from nmpm.decoders import Absolute, Acceleration, Blend, Flip, Residual
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.contact import Contact
from nmpm.emulator.monitor import Monitor
from nmpm.emulator.rollouts import unroll
from nmpm.grid import Grid
from nmpm.particles import Window
from nmpm.processors import FFNO, FNO, TFNO, Axial, ConvNeXt, Identity, Pointwise, UNet, UNetModern
from nmpm.training.losses import position_error
from nmpm.transfer import Affine, Linear, Nearest, Quadratic, scatter_backend, without_kernels

TRANSFERS = (Nearest(), Linear(), Quadratic(), Affine())
DECODERS = (Absolute(), Residual(), Flip(), Blend(), Acceleration())
PROCESSORS = (
    UNet(width=4, depth=1, perceptron=(5,)),
    UNetModern(width=4, growth=(1, 2), groups=2),
    ConvNeXt(width=6, depth=1, kernel=5),
    FNO(modes=4, width=6, layers=1),
    TFNO(modes=4, width=6, layers=1, rank=0.5),
    FFNO(modes=4, width=6, layers=1),
    Axial(width=8, layers=1, heads=2, patch=4),
    Pointwise(hidden=(6,)),
    Identity(),
)
CHANNEL = {"boundary": ("periodic", "wall"), "domain": ((0.1, 0.9), (0.08, 0.92))}
SCENES = {
    "walls": box(materials=("water", "sand"), densities=(1000.0, 1600.0)),
    "obstacles": box(obstacles=True),
    "periodic": box(materials=("water", "sand"), **CHANNEL),
    "periodic with obstacles": box(obstacles=True, **CHANNEL),
    "three axes": box(3, obstacles=True),
}


@pytest.fixture(autouse=True)
def _no_autocast(monkeypatch):
    """Torch has no `autocast` for meta."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())


def window(scene, frames: int = 6) -> Window:
    state = cloud(scene, count=9, batch=2, statics=4)
    steps = torch.arange(-1, frames - 1).view(1, -1, 1, 1)
    path = state.position.unsqueeze(1) + steps * state.velocity.unsqueeze(1)
    rest = (state.material, state.mask, state.obstacle, state.obstacle_mask, state.gravity)
    return Window(path, *rest).to("meta")


def emulator_of(
    scene, transfer=Linear(), processor=PROCESSORS[-2], decoder=Residual(), frames=2, **constraints
) -> Emulator:
    cells, held = (8,) * scene.dim, Constraints(**constraints)
    return EmulatorRecipe(scene, cells, frames, transfer, processor, decoder, 0.1, held).build().to("meta")


def train(emulator: Emulator, batch: Window, bundles: int = 1) -> None:
    predicted = torch.cat([bundle.position for bundle in unroll(emulator.train(), batch.initial, bundles)], dim=1)
    loss = position_error(predicted, batch.target[:, : predicted.shape[1]], batch.mask, emulator.grid)
    if loss.requires_grad:
        loss.backward()
    assert loss.device.type == "meta"
    assert all(weight.grad is None or weight.grad.device.type == "meta" for weight in emulator.parameters())


@torch.no_grad()
def roll(emulator: Emulator, batch: Window, monitor: Monitor | None = None) -> None:
    bundles = list(unroll(emulator.eval(), batch.initial, 2, monitor))
    assert [bundle.position.shape for bundle in bundles] == [(2, emulator.frames, 9, emulator.scene.dim)] * 2
    assert {bundle.position.device.type for bundle in bundles} == {"meta"}


PARTS = [
    *({"processor": part} for part in PROCESSORS),
    *({"transfer": part} for part in TRANSFERS),
    *({"decoder": part} for part in DECODERS),
]


@pytest.mark.parametrize("part", PARTS, ids=lambda part: type(next(iter(part.values()))).__name__)
def test_each_part_trains_and_rolls_out(part):
    emulator, batch = emulator_of(SCENES["walls"], **part, energy=True, rest_speed=0.01), window(SCENES["walls"])
    train(emulator, batch, bundles=2)
    with without_kernels(), scatter_backend("sorted" if "transfer" in part else "native"):
        roll(emulator, batch)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("bounds", ["stop", "reflect"])
def test_each_kind_of_scene_with_all_constraints_and_without(name, bounds):
    for limits in ({"energy": True, "rest_speed": 0.1, "density_cap": 2.0}, {"solids": False}):
        roll(emulator_of(SCENES[name], bounds=bounds, **limits), window(SCENES[name]))


def test_bounds_that_raise_errors_are_read_back_once_per_bundle(monkeypatch):
    checked = []
    monkeypatch.setattr("nmpm.emulator.advection.check_within_bounds", lambda path, *_: checked.append(path.shape))
    emulator, batch = emulator_of(SCENES["walls"], bounds="error", energy=True), window(SCENES["walls"])
    roll(emulator, batch)
    train(emulator, batch, bundles=2)
    assert len(checked) == 4


def test_a_monitor_reads_back_only_at_the_end(monkeypatch):
    read = []
    monkeypatch.setattr(Monitor, "read", lambda self: read.append(self._frames))
    roll(emulator_of(SCENES["walls"]), window(SCENES["walls"]), Monitor())
    assert read == [4]


def test_what_the_stand_in_finds():
    """The tests above would pass on any device if these did not raise."""
    grid = Grid((8, 8), (0.0, 0.0), (1.0, 1.0), (False, False))
    start, path = torch.zeros(1, 3, 2, device="meta"), torch.zeros(1, 2, 3, 2, device="meta")
    with pytest.raises(RuntimeError, match="device"):
        Contact(torch.zeros(1, 1, 8, 8), grid).hold_all(start, path)
    with pytest.raises(RuntimeError, match="meta"):
        Contact(torch.zeros(1, 1, 8, 8, device="meta"), grid).hold_touching(start, path)
