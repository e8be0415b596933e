"""The twin: the simulator with other time steps; the distance of the two estimates the simulator's own error."""

from __future__ import annotations

import dataclasses
from contextlib import suppress

from nmpm.errors import ConfigError
from nmpm.sim.preset import Preset


def twin_of(preset: Preset) -> Preset:
    """The preset with half as many substeps; with the fewest that the solver accepts where those are too few for it.

    Where it accepts no fewer, with twice as many.
    """
    for substeps in (-(-preset.substeps // 2), preset.stable_substeps):
        if substeps < preset.substeps:
            with suppress(ConfigError):
                return dataclasses.replace(preset, substeps=substeps)
    return dataclasses.replace(preset, substeps=2 * preset.substeps)
