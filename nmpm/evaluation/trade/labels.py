"""Label placement in a picture: of each name's candidate boxes, the one that overlaps the least, in pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

_DISTANCES = (14, 23, 36, 55, 78, 109, 150)  # of a name's edge from its point, pixels
_DIRECTIONS = tuple(math.radians(degrees) for degrees in (30, 330, 150, 210, 0, 180, 60, 300, 120, 240, 90, 270))
_GAP = 4  # between a line and its name
_STOPS = 16  # places along a line
_CROSSING = 1.5  # cost of covering a thin line, per square pixel; it is seen through a name
_FURTHER = 1.0  # cost of a later place, in covered square pixels


class Box(NamedTuple):
    """A rectangle along the axes, in pixels."""

    left: float
    bottom: float
    right: float
    top: float

    def overlap(self, other: Box) -> float:
        """Area that both cover."""
        width = min(self.right, other.right) - max(self.left, other.left)
        height = min(self.top, other.top) - max(self.bottom, other.bottom)
        return max(width, 0.0) * max(height, 0.0)

    @property
    def area(self) -> float:
        """Width × height."""
        return (self.right - self.left) * (self.top - self.bottom)


def boxes_around(x: float, y: float, width: float, height: float) -> Iterator[Box]:
    """Places of a name beside a point, the preferred ones first: near it, and to the right."""
    for distance in _DISTANCES:
        for angle in _DIRECTIONS:
            right, up = math.cos(angle), math.sin(angle)
            left = x + distance * right + width * (round(right, 6) > 0) - width
            if abs(right) < 0.6:  # above or below, in the middle
                left = x + distance * right - width / 2
            bottom = y + distance * up + height * (up - 1) / 2
            yield Box(left, bottom, left + width, bottom + height)


def boxes_along(y: float, width: float, height: float, inside: Box) -> Iterator[Box]:
    """Places of a name above and below a horizontal line through a box."""
    room = inside.right - inside.left - width - 2 * _GAP
    for stop in range(_STOPS):
        start = inside.left + _GAP + room * stop / (_STOPS - 1)
        for bottom in (y + _GAP, y - _GAP - height):
            yield Box(start, bottom, start + width, bottom + height)


def choose_boxes(
    candidates: Sequence[Sequence[Box]], taken: Sequence[Box], crossed: Sequence[Box], inside: Box
) -> list[Box]:
    """One box for each name, in turn: that which covers the least, the earlier of two such.

    Args:
        candidates: Boxes that each name may have, the preferred ones first.
        taken: What no name should cover, such as markers; names that have a place are added.
        crossed: Thin lines, which a name rather covers than those.
        inside: Names should not leave it.
    """
    taken, chosen = list(taken), []
    for places in candidates:
        costs = [_cost(box, taken, crossed, inside) + _FURTHER * index for index, box in enumerate(places)]
        chosen.append(places[costs.index(min(costs))])
        taken.append(chosen[-1])
    return chosen


def _cost(box: Box, taken: Sequence[Box], crossed: Sequence[Box], inside: Box) -> float:
    """Square pixels that are covered, or outside; a little of something counts as at least a quarter of the box."""
    outside = 4 * (box.area - box.overlap(inside))
    covered = sum(max(area, box.area / 4) for other in taken if (area := box.overlap(other)) > 0)
    return outside + covered + _CROSSING * sum(box.overlap(line) for line in crossed)
