"""Reference simulators: the source of the embedded datasets and the classical baseline of every comparison.

`preset.py` is what all simulators offer; `mpm/` (material point method, 2-D and 3-D) and `sph/` (weakly compressible
SPH, 2-D) implement it, and `presets/` describes the shipped scenes.
"""

from nmpm._support.shipped import preset_names
from nmpm.sim.loading import load_preset, name_parts, preset_from_dict
from nmpm.sim.mpm.layouts import SimulatedRamp
from nmpm.sim.mpm.preset import MpmPreset
from nmpm.sim.preset import Preset
from nmpm.sim.state import InitialState, SimulatedTrajectory

__all__ = [
    "InitialState",
    "MpmPreset",
    "Preset",
    "SimulatedRamp",
    "SimulatedTrajectory",
    "load_preset",
    "name_parts",
    "preset_from_dict",
    "preset_names",
]
