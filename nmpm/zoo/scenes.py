"""Scenes of the presets that models were trained on, as the simulator draws them, to start rollouts from."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch

from nmpm._support.plain_data import check_whole
from nmpm.data.format import Trajectory
from nmpm.data.recordings import RecordingReader
from nmpm.data.simulation import preset_metadata
from nmpm.data.windows import collate
from nmpm.emulator import Emulator
from nmpm.errors import DataError
from nmpm.particles import Particles, Window
from nmpm.scene import Reading, Scene
from nmpm.sim import Preset, load_preset, preset_names
from nmpm.sim.state import Progress
from nmpm.zoo.states import StateBuilder

SAME = 1e-3
"""Relative difference up to which lengths, times and volumes of model and preset are the same."""


def training_preset(ours: Scene, name: str | None) -> Preset | None:
    """The shipped preset of a name, if there is one, and its scenes are those that a model was trained on."""
    if name not in preset_names():
        return None
    preset = load_preset(str(name))
    theirs = preset.scene
    same = ours.materials == theirs.materials and ours.gravity_varies == theirs.gravity_varies
    same_frames = math.isclose(ours.dt, theirs.dt, rel_tol=SAME)
    return preset if same and same_frames and not scene_differences(ours, preset) else None


def scene_differences(scene: Scene, preset: Preset) -> list[str]:
    """Why a preset does not simulate a model's scenes: materials that it lacks, bounds, axes, volume of particles."""
    theirs = preset.scene
    unknown = [name for name in scene.materials if name not in theirs.materials]
    nearest = SAME * max(high - low for low, high in theirs.bounds)
    same_bounds = scene.dim == theirs.dim and np.allclose(scene.bounds, theirs.bounds, rtol=0, atol=nearest)
    same_volume = math.isclose(scene.particle_volume, theirs.particle_volume, rel_tol=SAME)
    differences = {
        f"it simulates {', '.join(theirs.materials)}, not {', '.join(unknown)}": bool(unknown),
        f"its bounds are {theirs.bounds}, the model's {scene.bounds}": not same_bounds,
        f"its axes are {theirs.boundary}, the model's {scene.boundary}": scene.boundary != theirs.boundary,
        f"its particles have the volume {theirs.particle_volume:g}, the model's {scene.particle_volume:g}": (
            not same_volume
        ),
    }
    return [difference for difference, differs in differences.items() if differs]


def simulate_scene(
    preset: Preset, seed: int, frames: int, gravity: tuple[float, ...] | None = None, progress: Progress | None = None
) -> Trajectory:
    """The scene that a preset draws for a seed, simulated for so many frames; gravity (D,) replaces the drawn one.

    Raises:
        ConfigError: if no initial state fits into the box.
        UnstableError: if the simulation becomes unstable.
    """
    start = preset.draw(check_whole("seed", seed, 0))
    start = start if gravity is None else dataclasses.replace(start, gravity=gravity)
    made = preset.simulate_from(start, frames, progress)
    return Trajectory(made.position, made.particle_type, made.attributes, metadata=preset_metadata(preset))


def scene_window(scene: Scene, trajectory: Trajectory) -> Window:
    """A simulated scene as tests read it: its first two frames to start from, and the others as the truth."""
    if trajectory.metadata is None:
        raise DataError("The trajectory lacks its metadata, which name the types of its particles.")
    reading = Reading(scene)
    reader = RecordingReader(trajectory.metadata, reading)
    return collate([reader.recording(trajectory, "the simulated scene")], reading)


def drawn_state(emulator: Emulator, preset: Preset, seed: int, gravity: Any) -> Particles:
    """The state of the scene that a preset draws for a seed, one simulated frame later, where rollouts of tests start.

    Raises:
        DataError: if gravity is not the model's.
    """
    scene, pull = emulator.scene, None
    if gravity is not None:
        stated = StateBuilder(emulator, np.zeros((1, scene.dim)), torch.float64).gravity(gravity)
        pull = tuple((stated[0] / scene.dt**2).tolist()) if scene.gravity_varies else None
    return scene_window(scene, simulate_scene(preset, seed, 1, pull)).initial
