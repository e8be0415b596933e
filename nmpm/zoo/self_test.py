"""The self-test of `nmpm doctor`: a simulation, rollouts and training steps, beside the figures that are expected."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import torch

from nmpm._support.shipped import shipped_folder
from nmpm.emulator.calibration import calibrate
from nmpm.particles import Window
from nmpm.processors import UNet
from nmpm.scene import Scene
from nmpm.training.module import EmulatorModule
from nmpm.zoo.card import stated_milliseconds
from nmpm.zoo.entries import load_entry
from nmpm.zoo.measures.scenes import iterate_scenes
from nmpm.zoo.measures.speed import measure_speed
from nmpm.zoo.verification import Check, verify_entry

MODEL = "goop"
"""Its scenes are not chaotic, so that their errors hardly depend on rounding."""
FRAMES, FIRST, STEPS = 8, 60, 10
"""Of the training: frames of a call; the frame, at which blobs hit the floor, that its window begins with; steps."""
LOSSES = (0.59757, 0.55428)
"""Of the first and the last step."""
RELATIVE = 0.02
"""Difference of a loss from the stated one that is tolerated, as rounding differs."""


def self_test(device: str = "cpu") -> Iterator[Check]:
    """Verify the shipped `MODEL` on scenes that are simulated here, and train a new network for `STEPS` steps."""
    folder = shipped_folder("zoo") / MODEL
    yield from verify_entry(folder, device=device)
    model = load_entry(folder)
    (scene,) = iterate_scenes("Training", model, None, 1, FIRST + FRAMES)
    losses = training_losses(model.scene, scene.pick_frames(slice(FIRST, None)), device)
    for step, stated, measured in zip((1, STEPS), LOSSES, (losses[0], losses[-1]), strict=True):
        bounds = ((1 - RELATIVE) * stated, (1 + RELATIVE) * stated)
        yield Check(
            f"training of {STEPS} steps, run: loss of step {step}", stated, measured, *bounds, stated_by="it should be"
        )


def training_losses(scene: Scene, window: Window, device: str) -> list[float]:
    """The losses of a small new network's first steps on one window; torch's random state stays as it was."""
    with torch.random.fork_rng(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Lightning's, as there is no Trainer
        torch.manual_seed(0)
        module = EmulatorModule(scene, cells=32, frames=FRAMES, unroll=1, processor=UNet(width=8, depth=1))
        calibrate(module.emulator, [window])
        module.to(device)
        optimizer, losses = module.make_optimizer(module.emulator.parameters()), []
        for step in range(STEPS):
            loss = module.training_step(window.to(device), step)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
    return losses


def speed(device: str = "cpu") -> str:
    """A line on the time per frame of `MODEL` here, and as its card states it."""
    model = load_entry(shipped_folder("zoo") / MODEL).to(device)
    measured: dict[str, Any] = measure_speed(model)
    stated = "; ".join(f"{time:.2f} on {hardware}" for hardware, time in stated_milliseconds(model.card).items())
    return (
        f"{measured['ms_per_frame']:.2f} ms per frame of {measured['particles']:,} particles, {measured['runtime']}, on"
        f" {measured['hardware']}. The card states {stated}."
    )
