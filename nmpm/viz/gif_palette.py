"""The colours of a GIF, chosen once and shared by all of its frames, so that nothing flickers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nmpm.viz.colours import FAINT_INK, INK, INTERIOR, PAGE, WALL, Rgb

SIZE = 64
"""Entries, the transparent one included; few, because a file shrinks by a quarter against 256 without looking worse."""
TRANSPARENT = SIZE - 1
"""The entry that no colour uses: a pixel that stays as it was in the frame before."""
GROUND = (PAGE, INTERIOR, WALL, INK, FAINT_INK)
BITS = 5
"""Bits per channel of the look-up table from colours to entries."""


class GifPalette:
    """A fixed palette and the way of every colour into it.

    Args:
        samples: Some frames (H, W, 3) that show what colours occur.
        exact: Colours that are kept to the bit however rare, besides those of page, walls and text.
    """

    def __init__(self, samples: Sequence[NDArray[np.uint8]], exact: Iterable[Rgb] = ()) -> None:
        kept = list(dict.fromkeys([*GROUND, *exact]))[: SIZE // 2]
        mosaic = Image.fromarray(np.concatenate(list(samples)))
        found = mosaic.quantize(TRANSPARENT - len(kept), method=Image.Quantize.MEDIANCUT).getpalette() or []
        self._colours = np.array(kept + np.reshape(found, (-1, 3)).tolist(), dtype=np.uint8)
        self._table = self._nearest(np.array(kept, dtype=np.uint8))

    def apply(self, frame: NDArray[np.uint8]) -> Image.Image:
        """A frame (H, W, 3) as a palette image."""
        image = Image.fromarray(self._table[_cell(frame)])
        padding = np.zeros((SIZE - len(self._colours), 3), dtype=np.uint8)
        image.putpalette(np.concatenate([self._colours, padding]).tobytes())
        return image

    def _nearest(self, kept: NDArray[np.uint8]) -> NDArray[np.uint8]:
        levels = (np.arange(1 << BITS, dtype=np.float32) + 0.5) * (1 << 8 - BITS)
        cells = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
        colours = self._colours.astype(np.float32)
        # |a - b|^2 without |a|^2, which does not change which is nearest.
        distance = np.square(colours).sum(axis=1) - 2 * cells @ colours.T
        table = np.asarray(np.argmin(distance, axis=1), dtype=np.uint8)
        table[_cell(kept)] = np.arange(len(kept))
        return table


def _cell(colours: NDArray[np.uint8]) -> NDArray[np.uint16]:
    red, green, blue = (colours[..., channel].astype(np.uint16) >> 8 - BITS for channel in range(3))
    return np.asarray(red << 2 * BITS | green << BITS | blue, dtype=np.uint16)
