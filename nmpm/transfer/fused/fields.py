"""A network's output as the fields that g2p reads: one after the other, the channels of a node side by side."""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit

_BLOCK = 64  # nodes


@jit
def unpack_float32(output: Any, scale: Any, fields: Any) -> Any:
    """Fill in the fields.

    Args:
        output: (m, C, size) float32, of any strides.
        scale: (m C,) factors.
        fields: (m, size, C), is filled.
    """
    channels = fields.shape[2]
    for begin in range(0, fields.shape[1], _BLOCK):
        end = min(begin + _BLOCK, fields.shape[1])
        for frame in range(len(fields)):
            for c in range(channels):
                these, field = output[frame, c, begin:end], fields[frame, begin:end]
                factor = scale[frame * channels + c]
                for node in range(len(these)):
                    field[node, c] = these[node] * factor


@jit
def unpack_bfloat16(output: Any, scale: Any, fields: Any) -> Any:
    """As `unpack_float32`, from the bits of bfloat16 numbers, uint16: the upper half of those of float32."""
    channels = fields.shape[2]
    bits = np.empty(_BLOCK, np.uint32)
    values = bits.view(np.float32)
    for begin in range(0, fields.shape[1], _BLOCK):
        end = min(begin + _BLOCK, fields.shape[1])
        for frame in range(len(fields)):
            for c in range(channels):
                these, field = output[frame, c, begin:end], fields[frame, begin:end]
                factor = scale[frame * channels + c]
                for node in range(len(these)):
                    bits[node] = np.uint32(these[node]) << np.uint32(16)
                for node in range(len(these)):
                    field[node, c] = values[node] * factor
