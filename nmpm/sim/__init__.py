"""Reference simulators: the source of the embedded datasets and the classical side of every comparison."""

from nmpm.sim.preset import Preset, load_preset, scene_of
from nmpm.sim.trajectory import SimulatedTrajectory, simulate, simulate_from

__all__ = ["Preset", "SimulatedTrajectory", "load_preset", "scene_of", "simulate", "simulate_from"]
