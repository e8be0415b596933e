"""A tiny simulated dataset, an emulator of it, and points with given times and errors."""

import dataclasses

import numpy as np

from nmpm.data.generate import generate
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.evaluation.trade import Kind, Point, Sweep, read_scenes, read_sweep
from nmpm.evaluation.trade.timing import Times
from nmpm.processors import Identity
from nmpm.sim import load_preset

SWEEP = """
scenes: 2
measures: {horizons: [4], emd_frames: 1}
timing: {rounds: 2, frames: 4}
models: {precision: [float32], batch: [1, 2]}
simulator: {coarser: [1, 2], substeps: [1, 0.5]}
"""


def tiny_scenes(folder):
    """Two test scenes of goop on a coarse grid, of ten frames."""
    preset = dataclasses.replace(load_preset("goop").coarsened(4).with_frames(10), substeps=6)
    generate(preset, folder, {"train": 0, "valid": 0, "test": 2}, workers=1)
    return read_scenes("tiny", folder, 2)


def tiny_emulator(scene):
    """Carries every particle on with the velocity of its cell."""
    free = Constraints(solids=False)
    return EmulatorRecipe(scene, cells=8, frames=2, processor=Identity(), constraints=free).build().eval()


def tiny_sweep() -> Sweep:
    return read_sweep(SWEEP, "test")


def point(name, kind=Kind.MODEL, time=1.0, errors=(1.0, 1.0), batch=1, failures=None, memory=2e6, **settings):
    """A point with so many milliseconds per frame and the same errors in all measures."""
    values = np.asarray(errors, dtype=float)
    times = Times((0.9 * time, time, 1.2 * time), (time,) * 3, memory, "CPU time", "a processor")
    measured = {"mse": values, "mse@8": values / 10, "emd": values}
    return Point(kind, name, settings, batch, 1, "cpu", times, measured, failures or {}, dt=0.01)
