"""Finds measurement noise: errors of positions that are new in each frame, such as those of tracked particles."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from nmpm.data.inspection.findings import Finding, Severity
from nmpm.data.inspection.motion import Motion

_LEAST_FRAMES = 8
_LOUD = 0.2  # of the typical displacement
_ENOUGH = 0.05  # of it, for velocities of a smoothed track
_WHITE = -0.6  # correlation of accelerations one frame apart: -2/3 for such errors, -1/2 for random walks
_MOST_FRAMES = 15


def find_noise(motion: Motion) -> Iterator[Finding]:
    """Yields a finding if positions are noisy: accelerations alternate as those of errors that are new in each frame.

    The second difference of independent errors of standard deviation σ has the variance 6 σ², and that of successive
    ones correlate by -2/3.
    """
    acceleration = np.diff(motion.step, axis=0)
    if len(motion.step) < _LEAST_FRAMES:
        return
    square = float(np.nanmean(acceleration**2))
    product = float(np.nanmean(acceleration[1:] * acceleration[:-1]))
    noise, typical = math.sqrt(square / 6), math.sqrt(float(np.nanmean(motion.step**2)))
    if not square or product / square > _WHITE or noise < _LOUD * typical:
        return
    frames = next((n for n in range(5, _MOST_FRAMES, 2) if _slope_error(n) * noise < _ENOUGH * typical), _MOST_FRAMES)
    yield Finding(
        "measurement noise",
        Severity.ODDITY,
        f"positions have errors of about {noise:.2g}, {noise / typical:.2g} of the typical displacement in a frame."
        f" Smooth them: nmpm convert FOLDER NEW --smooth {frames}.",
        motion.where,
        factor=noise / typical,
        badness=noise / typical,
    )


def _slope_error(frames: int) -> float:
    """The standard deviation of a slope that is fitted to so many frames, in errors of a position per frame."""
    return math.sqrt(12 / (frames**3 - frames))
