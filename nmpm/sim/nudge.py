"""Initial states that differ by less than anyone can measure: what a simulator cannot predict about itself."""

from __future__ import annotations

import dataclasses

import numpy as np

from nmpm.sim.initial_state import InitialState
from nmpm.sim.preset import Preset


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
