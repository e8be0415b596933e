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
    noise, typical = white_noise(motion.step)
    if noise < _LOUD * typical or not noise:
        return
    frames = smoothing_frames(noise / typical)
    yield Finding(
        "measurement noise",
        Severity.ODDITY,
        f"positions have errors of about {noise:.2g}, {noise / typical:.2g} of the typical displacement in a frame."
        f" Smooth them: nmpm convert FOLDER NEW --smooth {frames}.",
        motion.where,
        factor=noise / typical,
        badness=noise / typical,
    )


def white_noise(step: np.ndarray) -> tuple[float, float]:
    """The standard deviation of errors of positions, 0 where there are none, and the typical displacement in a frame.

    Of displacements (T, N, D), NaN where a particle is absent.
    """
    typical = math.sqrt(float(np.nanmean(step**2)))
    if len(step) < _LEAST_FRAMES:
        return 0.0, typical
    acceleration = np.diff(step, axis=0)
    square = float(np.nanmean(acceleration**2))
    product = float(np.nanmean(acceleration[1:] * acceleration[:-1]))
    return (math.sqrt(square / 6) if square and product / square <= _WHITE else 0.0), typical


def smoothing_frames(noise: float) -> int:
    """Frames of local fits that take noise, in typical displacements, out of velocities."""
    return next((n for n in range(5, _MOST_FRAMES, 2) if _slope_error(n) * noise < _ENOUGH), _MOST_FRAMES)


def _slope_error(frames: int) -> float:
    """The standard deviation of a slope that is fitted to so many frames, in errors of a position per frame."""
    return math.sqrt(12 / (frames**3 - frames))
