"""Packing trajectories for the page: 16-bit positions, as differences from frame to frame, deflated, in base64."""

from __future__ import annotations

import base64
import zlib

import numpy as np
from numpy.typing import NDArray

from nmpm.viz.trajectories import Floats

STEPS = 65535
"""Steps from the lowest to the highest position along an axis: an error of at most 1 / 131070 of the box."""


def quantize(position: Floats, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Positions (..., D) as multiples of (high - low) / 65535 above `low`, (D,) each."""
    return np.round((position - low) / (high - low) * STEPS).astype(np.uint16)


def pack_positions(steps: NDArray[np.uint16]) -> str:
    """Packs quantised positions (T, N, D), or other numbers (T, N), with particles drawn in this order.

    All low bytes precede all high bytes, which are mostly the same and so take next to no room.
    """
    change = steps.copy()
    change[1:] -= steps[:-1]  # (modulo 65536)
    flat = change.reshape(-1)
    return pack_bytes(np.concatenate([flat & 0xFF, flat >> 8]).astype(np.uint8))


def pack_bytes(values: NDArray[np.uint8]) -> str:
    """Deflated bytes as base64 text."""
    return base64.b64encode(zlib.compress(values.tobytes(), 6)).decode("ascii")
