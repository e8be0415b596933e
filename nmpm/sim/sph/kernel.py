"""The quintic spline kernel in two dimensions (Morris, Fox & Zhu 1997).

With q = r / h it is w(q) = (3 − q)⁵₊ − 6 (2 − q)⁵₊ + 15 (1 − q)⁵₊, W(r) = 7 / (478 π h²) · w(q). It is zero from
`SUPPORT` smoothing lengths on, its integral over the plane is one, and it has four continuous derivatives.
"""

from __future__ import annotations

import math

from nmpm._support.jit import jit

SUPPORT = 3.0
"""Reach of the kernel, in smoothing lengths."""

NORM = 7.0 / (478.0 * math.pi)
"""W = NORM / h² · w(q)."""


@jit
def weight(q: float) -> float:
    """The spline w at q ≥ 0, not normalised."""
    outer, middle, inner = max(0.0, 3.0 - q), max(0.0, 2.0 - q), max(0.0, 1.0 - q)
    outer2, middle2, inner2 = outer * outer, middle * middle, inner * inner
    return outer2 * outer2 * outer - 6.0 * (middle2 * middle2 * middle) + 15.0 * (inner2 * inner2 * inner)


@jit
def slope(q: float) -> float:
    """Its derivative dw / dq at q ≥ 0."""
    outer, middle, inner = max(0.0, 3.0 - q), max(0.0, 2.0 - q), max(0.0, 1.0 - q)
    outer2, middle2, inner2 = outer * outer, middle * middle, inner * inner
    return -5.0 * (outer2 * outer2 - 6.0 * (middle2 * middle2) + 15.0 * (inner2 * inner2))
