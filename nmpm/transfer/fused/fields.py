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
        output: (size, m C) float32.
        scale: (m C,) factors.
        fields: (m, size, C), is filled.
    """
    channels = fields.shape[2]
    for begin in range(0, len(output), _BLOCK):
        end = min(begin + _BLOCK, len(output))
        for frame in range(len(fields)):
            for node in range(begin, end):
                for c in range(channels):
                    k = frame * channels + c
                    fields[frame, node, c] = output[node, k] * scale[k]


@jit
def unpack_bfloat16(output: Any, scale: Any, fields: Any) -> Any:
    """As `unpack_float32`, from the bits of bfloat16 numbers, uint16: the upper half of those of float32."""
    width, channels = output.shape[1], fields.shape[2]
    bits = np.empty(_BLOCK * width, np.uint32)
    values = bits.view(np.float32)
    for begin in range(0, len(output), _BLOCK):
        end = min(begin + _BLOCK, len(output))
        for node in range(begin, end):
            for k in range(width):
                bits[(node - begin) * width + k] = np.uint32(output[node, k]) << np.uint32(16)
        for frame in range(len(fields)):
            for node in range(begin, end):
                for c in range(channels):
                    k = frame * channels + c
                    fields[frame, node, c] = values[(node - begin) * width + k] * scale[k]
