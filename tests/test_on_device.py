"""A GPU gives what the CPU gives: run with `--device cuda`; without it the CPU is compared with itself."""

import copy
from pathlib import Path

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from scenes import box, cloud

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator import Emulator, EmulatorRecipe, rollout
from nmpm.emulator.constraints import Constraints
from nmpm.metrics import MSE
from nmpm.optimizers import SOAP
from nmpm.processors import FNO, Processor, UNet
from nmpm.training import EmulatorModule
from nmpm.training.losses import PositionLoss
from nmpm.transfer import Affine, Linear, Quadratic, Transfer, scatter_backend, without_kernels
from nmpm.zoo import Zoo

SMALL = UNet(width=4, depth=1, perceptron=(4,))
HELD = {"energy": True, "bounds": "reflect", "rest_speed": 0.01}


def emulator_of(scene, processor: Processor = SMALL, transfer: Transfer = Linear(), **held) -> Emulator:
    torch.manual_seed(0)
    recipe = EmulatorRecipe(scene, 8, 3, transfer, processor, constraints=Constraints(**held))
    return recipe.build().eval().requires_grad_(False)


@pytest.mark.parametrize(
    ("dim", "processor", "transfer", "held"),
    [
        (2, SMALL, Linear(), {}),
        (2, FNO(modes=3, width=4, layers=1), Affine(), HELD),
        (3, SMALL, Quadratic(), {}),
        (3, SMALL, Linear(), HELD),
    ],
)
def test_rollouts_are_those_of_the_cpu_to_rounding(device, dim, processor, transfer, held):
    scene = box(dim, ("goop", "water"))
    emulator, particles = emulator_of(scene, processor, transfer, **held), cloud(scene, batch=2, speed=0.01)
    here = rollout(emulator, particles, 9)
    there = rollout(copy.deepcopy(emulator).to(device), particles.to(device), 9)
    assert there.device.type == device.type
    torch.testing.assert_close(there.cpu(), here, rtol=1e-4, atol=1e-5)


def test_particles_at_obstacles_move_as_on_the_cpu(device):
    scene = box()
    emulator, particles = emulator_of(scene, **HELD), cloud(scene, batch=2, speed=0.05, statics=40)
    here = rollout(emulator, particles, 9)
    there = rollout(copy.deepcopy(emulator).to(device), particles.to(device), 9)
    torch.testing.assert_close(there.cpu(), here, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", ["native", "sorted"])
def test_backends_of_p2g_give_the_same_gradients(device, name):
    scene = box()
    particles, gradients = cloud(scene, batch=2), []
    for place in (torch.device("cpu"), device):
        emulator = emulator_of(scene).to(place).requires_grad_()
        with scatter_backend(name):
            emulator(particles.to(place)).position.square().sum().backward()
        gradients.append(torch.cat([p.grad.flatten().cpu() for p in emulator.parameters()]))
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-3, atol=1e-4 * float(gradients[0].abs().max()))


@pytest.mark.parametrize("held", [{}, HELD | {"bounds": "stop"}])
def test_cuda_graphs_give_what_operations_one_by_one_give(device, held):
    if device.type != "cuda":
        pytest.skip("CUDA graphs need --device cuda")
    scene = box()
    emulator, particles = emulator_of(scene, **held).to(device), cloud(scene, batch=2, statics=5).to(device)
    recorded = copy.deepcopy(emulator)
    for state in (particles, cloud(scene, batch=2, statics=5, seed=1).to(device), particles):
        with without_kernels():
            expected = rollout(emulator, state, 12)
        torch.testing.assert_close(rollout(recorded, state, 12), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["goop", "waterramps"])
def test_a_model_of_the_zoo_rolls_out_as_on_the_cpu(device, name):
    here, there = Zoo.load(name).emulator, Zoo.load(name, device=device).emulator
    particles = cloud(here.scene, 200, speed=0.0)
    cell = min(here.grid.spacing)
    gap = rollout(there, particles.to(device), 16).cpu() - rollout(here, particles, 16)
    assert gap.abs().max() < 0.01 * cell


def fit(folder: Path, root: Path, device: torch.device, steps: int, **options) -> lightning.Trainer:
    data = TrajectoryDataModule(path=str(folder), horizon=4, batch_size=2, buffer_size=2, passes=1.0)
    torch.manual_seed(0)
    module = EmulatorModule(
        data.scene, cells=8, frames=2, unroll=2, processor=SMALL, optimizer=SOAP, metrics=[MSE((1, 4))], mirror=(0,),
        jitter=0.2, position_noise=1e-4, loss=PositionLoss(density_weight=1.0),
    )  # fmt: skip
    trainer = lightning.Trainer(
        accelerator="gpu" if device.type == "cuda" else device.type, devices=1, max_steps=steps, logger=False,
        default_root_dir=root, enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0,
        val_check_interval=2, check_val_every_n_epoch=None, log_every_n_steps=1,
        callbacks=[ModelCheckpoint(root, filename="last", every_n_train_steps=2, enable_version_counter=False)],
    )  # fmt: skip
    trainer.fit(module, data, weights_only=True, **options)
    return trainer


def test_a_training_learns_validates_and_resumes(device, make_dataset, tmp_path):
    folder = make_dataset()
    first = fit(folder, tmp_path, device, 4)
    assert first.strategy.root_device.type == device.type
    assert float(first.callback_metrics["valid/mse"]) > 0
    assert float(first.callback_metrics["train/loss"]) > 0
    resumed = fit(folder, tmp_path, device, 6, ckpt_path=tmp_path / "last.ckpt")
    assert resumed.global_step == 6
    assert resumed.strategy.root_device.type == device.type
    weights, before = ([p.detach().cpu() for p in t.lightning_module.parameters()] for t in (resumed, first))
    assert all(p.isfinite().all() for p in weights)
    assert any(not torch.equal(now, then) for now, then in zip(weights, before, strict=True))
