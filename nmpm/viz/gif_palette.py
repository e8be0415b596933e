"""The colour palette of a GIF, chosen once for all frames to avoid flicker."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nmpm.viz.colours import BACKGROUND, FAINT_TEXT, INTERIOR, TEXT, WALL, Rgb

SIZE = 64
"""Entries, including the transparent one. Files are a quarter smaller than with 256 and do not look worse."""
TRANSPARENT = SIZE - 1
"""Entry of pixels that keep their colour from the previous frame; no colour uses it."""
FIXED_COLOURS = (BACKGROUND, INTERIOR, WALL, TEXT, FAINT_TEXT)
BITS = 5
"""Bits per channel of the look-up table from colours to entries."""


class GifPalette:
    """A fixed palette, with a look-up table from RGB colours to its entries.

    Args:
        samples: Some frames (H, W, 3) from which the palette is chosen.
        exact: Colours kept exactly however rare they are, in addition to those of background, walls and text.
    """

    def __init__(self, samples: Sequence[NDArray[np.uint8]], exact: Iterable[Rgb] = ()) -> None:
        kept = list(dict.fromkeys([*FIXED_COLOURS, *exact]))[: SIZE // 2]
        mosaic = Image.fromarray(np.concatenate(list(samples)))
        chosen = mosaic.quantize(TRANSPARENT - len(kept), method=Image.Quantize.MEDIANCUT).getpalette() or []
        self._colours = np.array(kept + np.reshape(chosen, (-1, 3)).tolist(), dtype=np.uint8)
        self._table = self._build_table(np.array(kept, dtype=np.uint8))

    def quantize(self, frame: NDArray[np.uint8]) -> Image.Image:
        """Converts a frame (H, W, 3) to an image with this palette."""
        image = Image.fromarray(self._table[_table_index(frame)])
        padding = np.zeros((SIZE - len(self._colours), 3), dtype=np.uint8)
        image.putpalette(np.concatenate([self._colours, padding]).tobytes())
        return image

    def _build_table(self, kept: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The nearest entry to the centre of every table cell; the cell of a kept colour has that colour's entry."""
        levels = (np.arange(1 << BITS, dtype=np.float32) + 0.5) * (1 << 8 - BITS)
        cells = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
        colours = self._colours.astype(np.float32)
        # |a - b|^2 without |a|^2, which does not change the nearest entry.
        distance = np.square(colours).sum(axis=1) - 2 * cells @ colours.T
        table = np.asarray(np.argmin(distance, axis=1), dtype=np.uint8)
        table[_table_index(kept)] = np.arange(len(kept))
        return table


def _table_index(colours: NDArray[np.uint8]) -> NDArray[np.uint16]:
    red, green, blue = (colours[..., channel].astype(np.uint16) >> 8 - BITS for channel in range(3))
    return np.asarray(red << 2 * BITS | green << BITS | blue, dtype=np.uint16)
