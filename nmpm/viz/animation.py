"""Animations: the trajectories side by side, as a GIF or an MP4."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from nmpm._support.atomic import replacing
from nmpm.errors import ConfigError
from nmpm.viz.exhibit import Exhibit
from nmpm.viz.gif_palette import TRANSPARENT, GifPalette
from nmpm.viz.output import check_suffix
from nmpm.viz.progress import tracked
from nmpm.viz.reel import Reel

SAMPLES = 5
"""Frames that the palette of a GIF is chosen from."""
HOLD = 1.0
"""Seconds that a GIF rests on its last frame before it starts again."""


class _Order(NamedTuple):
    reel: Reel
    moments: list[int]
    fps: float
    name: str

    def drawn(self) -> Iterator[NDArray[np.uint8]]:
        """The frames, one after the other, with a progress bar where that takes long."""
        return tracked(map(self.reel.draw, self.moments), len(self.moments), f"Drawing {self.name}")


def animation(exhibit: Exhibit, path: Path | str, fps: float = 20.0, max_frames: int = 100, side: int = 320) -> Path:
    """Writes an animation of the trajectories, side by side in the exhibit's order.

    Args:
        exhibit: What to draw.
        path: A `.gif` or `.mp4` file; replaced only once the new one is whole.
        fps: Drawn frames per second; a GIF counts hundredths of a second and rounds to them.
        max_frames: Draws at most so many frames, evenly spread from the first to the last.
        side: Side of a square panel in pixels.

    Returns:
        The path.

    Raises:
        ConfigError: if the suffix is not supported, a number is out of range, or MP4 lacks its encoder.
    """
    path = Path(path)
    write = _WRITERS[check_suffix(path, _WRITERS, "an animation")]
    if not 0 < fps <= 50:
        raise ConfigError(f"fps = {fps} must be above 0 and at most 50, the fastest that viewers play.")
    if max_frames < 1 or not 64 <= side <= 4096:
        raise ConfigError(f"max_frames = {max_frames} must be at least 1, and side = {side} within 64 and 4096 pixels.")
    order = _Order(Reel(exhibit, side), exhibit.spread(max_frames), fps, path.name)
    with replacing(path) as temporary:
        write(order, temporary)
    return path


def _write_gif(order: _Order, path: Path) -> None:
    spread = np.linspace(0, len(order.moments) - 1, SAMPLES).astype(int)
    samples = [order.reel.draw(order.moments[place]) for place in dict.fromkeys(spread.tolist())]
    chosen = GifPalette(samples, order.reel.colours)
    first, *rest = (chosen.apply(frame) for frame in order.drawn())
    frame_time = round(100 / order.fps) * 10
    durations = [frame_time] * len(rest) + [max(frame_time, round(HOLD * 1000))]
    # With `optimize` and a transparent entry, a frame stores only the pixels that changed.
    first.save(
        path,
        format="GIF",
        save_all=True,
        append_images=rest,
        duration=durations if rest else durations[0],
        loop=0,
        disposal=1,
        optimize=True,
        transparency=TRANSPARENT,
    )


def _write_mp4(order: _Order, path: Path) -> None:
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ConfigError(
            "MP4 needs a video encoder that is not installed: `pip install 'nmpm[video]'`, or write a .gif instead."
        )
    encoder: Any = imageio.get_writer(
        path, format="FFMPEG", mode="I", fps=order.fps, codec="libx264", quality=8, macro_block_size=2
    )
    with encoder as video:
        for frame in order.drawn():
            video.append_data(frame)


_WRITERS: Mapping[str, Callable[[_Order, Path], None]] = MappingProxyType({".gif": _write_gif, ".mp4": _write_mp4})
