"""Reference simulators: the source of the embedded datasets and the classical side of every comparison."""

from nmpm.sim.loading import load_preset, preset_from_dict, preset_names
from nmpm.sim.mpm import simulate_from
from nmpm.sim.mpm_preset import MpmPreset
from nmpm.sim.preset import Preset
from nmpm.sim.trajectory import SimulatedTrajectory

__all__ = [
    "MpmPreset",
    "Preset",
    "SimulatedTrajectory",
    "load_preset",
    "preset_from_dict",
    "preset_names",
    "simulate_from",
]
