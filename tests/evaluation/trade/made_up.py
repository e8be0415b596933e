"""A tiny dataset, an emulator of it, a predictor of another package, and points with given times and errors."""

import dataclasses

import numpy as np
import torch

from nmpm.data.simulation import generate
from nmpm.data.sources import FolderSource
from nmpm.data.windows import Recording
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.evaluation.trade import Kind, Point, Scenes, Sweep, read_scenes, read_sweep
from nmpm.evaluation.trade.ranking import Times
from nmpm.processors import Identity
from nmpm.scene import Scene
from nmpm.sim import load_preset

SWEEP = """
scenes: 2
measures: {horizons: [4], emd_frames: 1, emd_particles: 40}
timing: {rounds: 2, frames: 4}
models: {precision: [float32], runtime: [eager], batch: [1, 2]}
simulator: {coarser: [1, 2], substeps: [1, 0.5]}
"""


def tiny_scenes(folder):
    """Two test scenes of goop on a coarse grid, of ten frames."""
    preset = dataclasses.replace(load_preset("goop").coarsened(4).with_frames(10), substeps=6)
    generate(preset, folder, {"train": 0, "valid": 0, "test": 2}, workers=1)
    return read_scenes("tiny", FolderSource(folder), 2)


def tiny_emulator(scene):
    """Carries every particle on with the velocity of its cell."""
    free = Constraints(solids=False)
    return EmulatorRecipe(scene, cells=8, frames=2, processor=Identity(), constraints=free).build().eval()


def tiny_sweep() -> Sweep:
    return read_sweep(SWEEP, "test")


class Shifted:
    """A predictor of another package: all particles move by a constant step."""

    def __init__(self, scene, step="0"):
        self.name, self.step = f"shifted by {step}", float(step)

    def __call__(self, particles, frames):
        steps = self.step * torch.arange(1, frames + 1).view(1, -1, 1, 1)
        return particles.position.unsqueeze(1) + steps


def flow(start, steps):
    """Scenes of 100 particles in a square of period 1 along x, that start at x = `start` and move by `steps` (T,)."""
    scene = Scene(
        bounds=((0.0, 1.0),) * 2, domain=((0.0, 1.0),) * 2, dt=0.01, materials=("water",), particle_volume=1e-3,
        boundary=("periodic", "wall"), gravity=(0.0, -9.81),
    )  # fmt: skip
    places = np.stack(np.meshgrid(np.linspace(start, start + 0.2, 10), np.linspace(0.1, 0.4, 10)), -1).reshape(-1, 2)
    shift = np.stack([np.concatenate([[0], np.cumsum(steps)]), np.zeros(len(steps) + 1)], -1)
    frames = torch.from_numpy(places + shift[:, None]).float()
    frames[..., 0] = frames[..., 0].remainder(1.0)
    gravity = torch.tensor([0.0, -9.81e-4])
    recording = Recording(frames, torch.zeros(100, dtype=torch.long), torch.zeros(0, 2), gravity)
    return Scenes("flow", scene, (recording,))


def point(name, kind=Kind.MODEL, time=1.0, errors=(1.0, 1.0), batch=1, failures=None, **settings):
    """A point with so many milliseconds per frame and the same errors in all measures."""
    values = np.asarray(errors, dtype=float)
    times = Times((0.9 * time, time, 1.2 * time), 2e6, "CPU time", "a processor")
    measured = {"mse": values, "mse@8": values / 10, "emd": values}
    curves = np.repeat(values[:, None], 5, axis=1)
    return Point(kind, name, settings, batch, "cpu", times, measured, failures or {}, curves)
