"""The words on pictures."""

from __future__ import annotations

import math

from nmpm.viz.exhibit import Exhibit


def clock(exhibit: Exhibit, frame: int) -> str:
    """The time of a frame in seconds, with the same number of decimals for every frame of an exhibit."""
    longest = max(exhibit.frames - 1, 1) * exhibit.dt
    decimals = max(0, 2 - math.floor(math.log10(longest)))
    return f"{frame * exhibit.dt:.{decimals}f} s"


def distance(exhibit: Exhibit, length: float) -> str:
    """A distance in domain length, to about a thousandth of the box, with as many decimals for every frame;
    in powers of ten where it is far beyond the box.
    """
    longest = max(high - low for low, high in exhibit.bounds)
    decimals = max(0, 3 - math.floor(math.log10(longest)))
    return f"{length:.{decimals}f}" if length < 100 * longest else f"{length:.1e}"


def unseen(count: int) -> str:
    """What is said of particles that left the picture; nothing where none did."""
    return f"{count} out of view" if count else ""
