"""Scenes to start playing from: a model's own, with ramps as bodies that may be moved."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

from nmpm.obstacles import Body, Ramp
from nmpm.particles import Particles
from nmpm.sim import Preset, SimulatedRamp
from nmpm.sim.mpm.mixture import MpmMixture
from nmpm.zoo.scenes import training_preset

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


def simulator_of(model: Pretrained) -> Preset | None:
    """The preset that simulates a model's scenes from any state; None where there is none."""
    preset = training_preset(model)
    return None if isinstance(preset, MpmMixture) else preset


def start_of(model: Pretrained, seed: int) -> Start:
    """The scene of a seed, as `Pretrained.example` gives it."""
    state, preset = model.example(seed).to(model.emulator.device), simulator_of(model)
    obstacles = () if preset is None else preset.draw(seed).obstacles
    ramps = [ramp for ramp in obstacles if isinstance(ramp, SimulatedRamp) and len(ramp.centre) == 2]
    if not ramps or len(ramps) < len(obstacles):
        return Start(state)
    bodies = tuple(Ramp(ramp.centre, ramp.length, ramp.thickness, ramp.angle) for ramp in ramps)
    none = state.obstacle[:, :0]
    return Start(dataclasses.replace(state, obstacle=none, obstacle_mask=state.obstacle_mask[:, :0]), bodies)
