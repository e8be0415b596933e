"""Text in pictures: times, distances and the count of particles out of view."""

from __future__ import annotations

import math

from nmpm.viz.trajectories import LabelledTrajectories


def format_time(trajectories: LabelledTrajectories, frame: int) -> str:
    """The time of a frame in seconds, with the same number of decimals for every frame."""
    longest = max(trajectories.frame_count - 1, 1) * trajectories.dt
    decimals = max(0, 2 - math.floor(math.log10(longest)))
    return f"{frame * trajectories.dt:.{decimals}f} s"


def format_distance(trajectories: LabelledTrajectories, length: float) -> str:
    """A distance in domain length, rounded to about a thousandth of the box, with the same number of decimals for every
    frame; in scientific notation from 100 box lengths on.
    """
    longest = max(high - low for low, high in trajectories.bounds)
    decimals = max(0, 3 - math.floor(math.log10(longest)))
    return f"{length:.{decimals}f}" if length < 100 * longest else f"{length:.1e}"


def format_out_of_view(count: int) -> str:
    """States how many particles lie outside of the picture; empty for none."""
    return f"{count} out of view" if count else ""
