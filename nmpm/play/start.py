"""Scenes to start playing from: the preset's own where it is known, thrown blocks elsewhere."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nmpm.obstacles import Body, Ramp
from nmpm.particles import Particles
from nmpm.sim import Preset, SimulatedRamp, load_preset
from nmpm.sim.mpm.mixture import MpmMixture
from nmpm.sim.preset import BOUNDARY

if TYPE_CHECKING:
    from nmpm.zoo import Pretrained


@dataclass(frozen=True)
class Start:
    """A scene at its first frame.

    Args:
        particles: One scene (B = 1), with the obstacles that stay where they are.
        bodies: Further obstacles, which may be moved.
    """

    particles: Particles
    bodies: tuple[Body, ...] = ()


def playable_preset(model: Pretrained) -> Preset | None:
    """The simulator preset whose scenes are the model's; None where there is none."""
    if model.preset is None or model.match is not None:
        return None
    preset, scene = load_preset(model.preset), model.scene
    same = np.allclose(preset.scene.bounds, scene.bounds) if preset.scene.dim == scene.dim else False
    is_plain = not isinstance(preset, MpmMixture) and not scene.fields
    return preset if same and is_plain and set(preset.scene.materials) <= set(scene.materials) else None


def start_of(model: Pretrained, seed: int) -> Start:
    """The scene of a seed: drawn by the model's preset, or blocks of particles."""
    preset = playable_preset(model)
    if preset is None:
        return Start(model.example(seed, min(1000, _room(model) // 4)))
    drawn = preset.draw(seed)
    ramps = [ramp for ramp in drawn.obstacles if isinstance(ramp, SimulatedRamp) and not ramp.width]
    bodies = tuple(Ramp(ramp.centre, ramp.length, ramp.thickness, ramp.angle) for ramp in ramps)
    static = None if bodies and len(ramps) == len(drawn.obstacles) else _static_particles(preset, seed)
    names = np.repeat(preset.scene.materials, drawn.counts_of(len(preset.scene.materials)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # (such starts are those of the training)
        particles = model.state(
            drawn.position,
            drawn.velocity,
            names,
            obstacle=static if model.scene.obstacles else None,
            gravity=drawn.gravity if model.scene.gravity_varies else None,
        )
    return Start(particles, bodies)


def _room(model: Pretrained) -> int:
    """Particles that fill the box."""
    return int(model.scene.volume / model.scene.particle_volume)


def _static_particles(preset: Preset, seed: int) -> np.ndarray | None:
    """(M, D) the particles of a seed's scene that do not move: walls and obstacles."""
    first = preset.simulate_from(preset.draw(seed), 0)
    static = first.position[0, first.particle_type == BOUNDARY]
    return static if len(static) else None
