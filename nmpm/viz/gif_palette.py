"""The 256 colours of a GIF, chosen once and shared by all of its frames, so that nothing flickers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nmpm.viz.colours import FAINT_INK, INK, INTERIOR, PAGE, WALL

EXACT = (PAGE, INTERIOR, WALL, INK, FAINT_INK)
"""Large areas and text, whose colours are kept to the bit."""
BITS = 5
"""Bits per channel of the look-up table from colours to palette entries."""


class GifPalette:
    """A fixed palette and the way of every colour into it.

    Args:
        samples: Some frames (H, W, 3) that show what colours occur.
    """

    def __init__(self, samples: Sequence[NDArray[np.uint8]]) -> None:
        mosaic = Image.fromarray(np.concatenate(list(samples)))
        chosen = mosaic.quantize(256 - len(EXACT), method=Image.Quantize.MEDIANCUT).getpalette() or []
        self._colours = np.concatenate([np.array(EXACT, dtype=np.uint8), np.array(chosen, np.uint8).reshape(-1, 3)])
        self._table = self._nearest()

    def apply(self, frame: NDArray[np.uint8]) -> Image.Image:
        """A frame (H, W, 3) as a palette image."""
        image = Image.fromarray(self._table[_cell(frame)])
        image.putpalette(self._colours.tobytes())
        return image

    def _nearest(self) -> NDArray[np.uint8]:
        levels = (np.arange(1 << BITS) + 0.5) * (1 << 8 - BITS)
        cells = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
        colours = self._colours.astype(np.float64)
        # |a - b|^2 without |a|^2, which does not change which is nearest.
        distance = np.square(colours).sum(axis=1) - 2 * cells @ colours.T
        table = np.argmin(distance, axis=1).astype(np.uint8)
        for entry, exact in reversed(list(enumerate(EXACT))):
            table[_cell(np.array(exact, dtype=np.uint8))] = entry
        return table


def _cell(colours: NDArray[np.uint8]) -> NDArray[np.uint16]:
    red, green, blue = (colours[..., channel].astype(np.uint16) >> 8 - BITS for channel in range(3))
    return red << 2 * BITS | green << BITS | blue
