"""Trainings on particles that enter and leave, and on particles beside a paddle, made by arithmetic."""

import dataclasses
from functools import partial

import numpy as np
import pytest
import torch
from torch.optim import Adam

from nmpm.cli import main
from nmpm.data.format import Split, Trajectory, write_metadata, write_split
from nmpm.emulator import Prescribed, Rollout, RolloutOptions, rollout
from nmpm.emulator.calibration import calibrate
from nmpm.grid import Grid
from nmpm.particles import Window
from nmpm.processors import UNet
from nmpm.training.losses import PositionLoss, counted, density_error, position_error, tempered_error
from nmpm.training.optimization import Schedule
from tests.made_up import made_up_metadata
from tests.scenes import box, cloud, emulator_of
from tests.trainings import data_of, module_of, trainer_of

FRAMES = 30
MEANDER = 0.012


def channel(seed: int) -> Trajectory:
    """Tracers that enter a meandering stream on the left, two in each frame, and leave on the right or at once."""
    rng = np.random.default_rng(seed)
    before, per_frame = 60, 2
    begins = np.repeat(np.arange(-before, FRAMES), per_frame)
    place = np.stack([np.full(len(begins), 0.1), rng.uniform(0.3, 0.7, len(begins))], axis=1)
    path = np.full((FRAMES, len(begins), 2), np.nan)
    for frame in range(-before, FRAMES):
        moving = begins < frame
        for _ in range(4):
            flow = np.stack([np.full(len(place), 0.02), MEANDER * np.cos(4 * np.pi * place[:, 0])], axis=1)
            place[moving] += flow[moving] / 4
        if frame >= 0:
            there = (begins <= frame) & (place[:, 0] < 0.9)
            path[frame, there] = place[there]
    ever = ~np.isnan(path[..., 0]).all(axis=0)
    return Trajectory(path[:, ever].astype(np.float32), np.full(ever.sum(), 7), {})


def beside_paddle(seed: int) -> Trajectory:
    """Particles that a paddle drags along, the more the nearer they are to it."""
    rng = np.random.default_rng(seed)
    paddle = np.stack([np.full(12, 0.3), np.linspace(0.2, 0.8, 12)], axis=1)
    place, speed = rng.uniform(0.35, 0.7, (40, 2)), rng.uniform(0.002, 0.004)
    phase, frames = rng.uniform(0, 2 * np.pi), []
    for frame in range(FRAMES):
        along = speed * (1 - np.cos(2 * np.pi * frame / 12 + phase))
        frames.append(np.concatenate([place, paddle]))
        paddle = paddle + np.array([along, 0.0])
        near = np.exp(-3 * (place[:, 0] - paddle[0, 0]))
        place = place + along * near[:, None] * np.array([1.0, 0.3])
    return Trajectory(np.array(frames, np.float32), np.r_[np.full(40, 7), np.full(12, 2)], {})


def dataset(folder, make, **metadata):
    folder.mkdir()
    for split, seeds in {"train": range(6), "valid": range(6, 8), "test": range(8, 10)}.items():
        write_split(folder / f"{split}.h5", [make(seed) for seed in seeds])
    facts = {"gravity": (0.0, 0.0), "sequence_length": FRAMES - 1, "particle_volume": 0.0009}
    write_metadata(folder, made_up_metadata(**(facts | metadata)))
    return folder


@pytest.fixture(scope="module")
def stream(tmp_path_factory):
    return dataset(tmp_path_factory.mktemp("stream") / "data", channel, boundary=("open", "wall"))


@pytest.fixture(scope="module")
def paddled(tmp_path_factory):
    types = {
        "particle_types": {2: "paddle", 7: "goop"},
        "static_types": frozenset(),
        "prescribed_types": frozenset({2}),
    }
    return dataset(tmp_path_factory.mktemp("paddle") / "data", beside_paddle, **types)


def trained(folder, root, steps: int):
    data = data_of(folder, batch_size=4)
    form = {"cells": (20, 21), "processor": UNet(width=8, depth=1, perceptron=(8,)), "schedule": Schedule(warmup=5)}
    module = module_of(data, grid_noise=0.0, position_noise=0.0, optimizer=partial(Adam, lr=5e-3), **form)
    trainer = trainer_of(root, steps, val_check_interval=steps)
    trainer.fit(module, data)
    [errors] = trainer.test(module, data, verbose=False)
    return module, errors


def test_a_stream_with_inflow_and_outflow_trains_and_is_scored_and_rolled_out(stream, tmp_path, monkeypatch, capsys):
    _, errors = trained(stream, tmp_path, 60)
    assert errors["test/mse"] < 0.1 * errors["test/still/mse"]
    assert errors["test/mse"] < 0.5 * errors["test/free_fall/mse"]
    monkeypatch.chdir(tmp_path)
    main(["rollout", str(tmp_path / "last.ckpt"), "--data", str(stream / "test.h5"), "--out", "out.h5"])
    assert "nothing moves" in capsys.readouterr().out
    written = Split(tmp_path / "out.h5").read(0).position
    assert np.isnan(written).any()
    assert np.isfinite(written).any()


def test_a_paddle_is_seen_and_not_scored(paddled, tmp_path):
    module, errors = trained(paddled, tmp_path, 60)
    scene = module.emulator.scene
    assert "solid.velocity_x" in scene.input_channels
    assert errors["test/mse"] < 0.5 * errors["test/still/mse"]
    data = data_of(paddled)
    data.setup("test")
    [window, *_] = data.test_dataloader()
    emulator = module.emulator.eval()
    frames = window.target.shape[1]
    with torch.no_grad():
        moved = rollout(emulator, window.initial, frames, RolloutOptions(Prescribed.of(window)))
        resting = rollout(emulator, window.initial, frames)
    truth = window.target
    assert (moved - truth).square().mean() < (resting - truth).square().mean()


def test_a_resumed_training_of_a_stream_ends_with_the_same_weights(stream, tmp_path):
    def made():
        return module_of(data_of(stream)), data_of(stream)

    whole, resumed = made(), made()
    trainer_of(tmp_path / "whole", 4).fit(*whole)
    trainer_of(tmp_path / "parts", 2).fit(*made())
    trainer_of(tmp_path / "parts", 4).fit(*resumed, ckpt_path=tmp_path / "parts" / "last.ckpt", weights_only=True)
    for name, value in whole[0].state_dict().items():
        assert torch.equal(value, resumed[0].state_dict()[name]), name


def test_the_loss_of_a_stream_does_not_depend_on_the_parts_that_threads_compute(stream):
    data = data_of(stream, batch_size=4)
    data.setup("fit")
    window = next(iter(data.train_dataloader()))
    losses, gradients = [], []
    for parts in (1, 2, 4):
        module = module_of(data, grid_noise=0.0, position_noise=0.0)
        calibrate(module.emulator, [window])
        module.parts, module.log = parts, lambda *_: None
        loss = module.training_step(window, 0)
        losses.append(loss.detach())
        gradients.append(torch.cat([g.flatten() for g in torch.autograd.grad(loss, list(module.parameters()))]))
    for parts in (1, 2):
        torch.testing.assert_close(losses[parts], losses[0])
        torch.testing.assert_close(gradients[parts], gradients[0], rtol=1e-3, atol=1e-6)


def with_presence(window: Window, frames: int) -> Window:
    """The first half of the particles there throughout, the others never."""
    present = torch.zeros(len(window.mask), frames, window.mask.shape[1], dtype=torch.bool)
    present[..., : window.mask.shape[1] // 2] = True
    return dataclasses.replace(window, present=present)


def test_losses_are_those_of_the_particles_there_alone():
    scene = box(materials=("water", "sand"))
    emulator, state = emulator_of(scene, 42), cloud(scene, 10, batch=2)
    frames = state.position.unsqueeze(1) + 0.01 * torch.rand(2, 10, 10, 2)
    window = dataclasses.replace(Window.of(state), frames=frames)
    few = Window(frames[:, :, :5], *(v[:, :5] for v in (state.material, state.mask)), *(
        state.obstacle, state.obstacle_mask, state.gravity
    ))  # fmt: skip
    predicted = (window.target + 0.02 * torch.randn(2, 8, 10, 2)).requires_grad_()
    alone = predicted.detach()[:, :, :5].clone().requires_grad_()
    for power, weight in ((1.0, 0.0), (0.5, 4.0)):
        loss = PositionLoss(power, weight)
        here = loss(Rollout(predicted, {}), with_presence(window, 10), emulator)
        there = loss(Rollout(alone, {}), few, emulator)
        torch.testing.assert_close(here, there)
        (one,), (other,) = torch.autograd.grad(here, [predicted]), torch.autograd.grad(there, [alone])
        torch.testing.assert_close(one[:, :, :5], other)
        assert not one[:, :, 5:].any()
    nobody = dataclasses.replace(window, present=torch.zeros(2, 10, 10, dtype=torch.bool))
    assert PositionLoss()(Rollout(predicted, {}), nobody, emulator).item() == 0
    assert counted(nobody, 8, 4).sum() == 0


def test_density_errors_count_particles_by_their_volume():
    scene, grid = box(), Grid.of(box(), 42)
    state = cloud(scene, 6)
    window = Window.of(state)
    there = window.frames[:, 1:]
    moved = there + 0.01
    twice = window.map(lambda values: torch.cat([values, values], dim=2 if values.dim() == 4 else 1)
                       if 6 in values.shape else values)  # fmt: skip
    double = dataclasses.replace(window, volume=torch.full((1, 6), 2.0))
    pair = density_error(torch.cat([moved, moved], 2), torch.cat([there, there], 2), twice, scene, grid)
    torch.testing.assert_close(density_error(moved, there, double, scene, grid), pair)
    assert tempered_error(torch.ones(1, 1), window.mask, 1.0) > 0
    assert position_error(moved, there, window.mask, grid) > 0


def test_calibration_of_a_stream_is_finite_and_of_those_there(stream):
    data = data_of(stream, batch_size=4)
    module = module_of(data)
    data.setup("fit")
    windows = [window for window, _ in zip(data.train_dataloader(), range(3), strict=False)]
    assert any(window.present is not None for window in windows)
    calibrate(module.emulator, windows)
    assert all(value.isfinite().all() for value in module.emulator.state_dict().values())
