"""What a simulator cannot predict about itself: other time steps, and initial states that hardly differ."""

from __future__ import annotations

import dataclasses
from contextlib import suppress

import numpy as np

from nmpm.errors import ConfigError
from nmpm.sim.preset import Preset
from nmpm.sim.state import InitialState


def twin_of(preset: Preset) -> Preset:
    """The twin: the simulator with half as many substeps; with the fewest that the solver accepts if that is more.

    Where it accepts no fewer, with twice as many. The distance of the two estimates the simulator's own error.
    """
    for substeps in (-(-preset.substeps // 2), preset.stable_substeps):
        if substeps < preset.substeps:
            with suppress(ConfigError):
                return dataclasses.replace(preset, substeps=substeps)
    return dataclasses.replace(preset, substeps=2 * preset.substeps)


def nudge(preset: Preset, start: InitialState, share: float, seed: int) -> InitialState:
    """The state with Gaussian noise on its positions, which stay within the box.

    Args:
        preset: Gives domain and box.
        start: Of the preset.
        share: Standard deviation of the noise, as a share of the domain's longest side.
        seed: Of the noise.
    """
    side = max(high - low for low, high in preset.domain)
    noise = share * side * np.random.default_rng(seed).standard_normal(start.position.shape)
    low, high = np.array(preset.box).T
    low, high = np.minimum(low, start.position.min(0)), np.maximum(high, start.position.max(0))
    return dataclasses.replace(start, position=np.clip(start.position + noise, low, high))
