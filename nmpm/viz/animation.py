"""Animations: the trajectories side by side, as a GIF or an MP4."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from nmpm._support.progress import progress_bar
from nmpm.errors import ConfigError
from nmpm.viz.frame_renderer import FrameRenderer
from nmpm.viz.gif_palette import TRANSPARENT, GifPalette
from nmpm.viz.output import check_output, check_suffix, replace_picture
from nmpm.viz.trajectories import LabelledTrajectories

PALETTE_SAMPLES = 5
"""Number of frames from which the palette of a GIF is chosen."""
LAST_FRAME_SECONDS = 1.0
"""How long a GIF shows its last frame before it starts again."""


class _Animation(NamedTuple):
    renderer: FrameRenderer
    frames: list[int]
    fps: float
    name: str

    def draw_frames(self) -> Iterator[NDArray[np.uint8]]:
        """Draws the frames in order, with a progress bar."""
        with progress_bar(f"Drawing {self.name}", len(self.frames)) as step:
            for frame in self.frames:
                yield self.renderer.draw(frame)
                step()


def write_animation(
    trajectories: LabelledTrajectories, path: Path | str, fps: float = 20.0, max_frames: int = 100, side: int = 320
) -> Path:
    """Writes an animation of the trajectories, side by side in the given order.

    Args:
        trajectories: What to draw.
        path: A `.gif` or `.mp4` file; an existing one is replaced only when the new one is complete.
        fps: Drawn frames per second; a GIF rounds the time per frame to hundredths of a second.
        max_frames: Largest number of frames to draw, evenly spaced from the first to the last.
        side: Side of a square panel in pixels.

    Returns:
        The path.

    Raises:
        ConfigError: if the suffix is not supported, an argument is out of range, or the MP4 encoder is not installed.
        DataError: if the file cannot be written; a missing or read-only folder is found before drawing.
    """
    path = Path(path)
    write = _WRITERS[check_suffix(path, _WRITERS, "an animation")]
    if not 0 < fps <= 50:
        raise ConfigError(f"fps = {fps} must be above 0 and at most 50, the highest rate that viewers play.")
    if max_frames < 1 or not 64 <= side <= 4096:
        raise ConfigError(f"max_frames = {max_frames} must be at least 1, and side = {side} within 64 and 4096 pixels.")
    check_output(path)
    frames = trajectories.evenly_spaced_frames(max_frames)
    animation = _Animation(FrameRenderer(trajectories, side), frames, fps, path.name)
    with replace_picture(path) as temporary:
        write(animation, temporary)
    return path


def _write_gif(animation: _Animation, path: Path) -> None:
    indices = np.linspace(0, len(animation.frames) - 1, PALETTE_SAMPLES).astype(int)
    samples = [animation.renderer.draw(animation.frames[index]) for index in dict.fromkeys(indices.tolist())]
    palette = GifPalette(samples, animation.renderer.colours)
    first, *rest = (palette.quantize(frame) for frame in animation.draw_frames())
    frame_time = round(100 / animation.fps) * 10
    durations = [frame_time] * len(rest) + [max(frame_time, round(LAST_FRAME_SECONDS * 1000))]
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


def _write_mp4(animation: _Animation, path: Path) -> None:
    encoder: Any = imageio.get_writer(
        path, format="FFMPEG", mode="I", fps=animation.fps, codec="libx264", quality=8, macro_block_size=2
    )
    with encoder as video:
        for frame in animation.draw_frames():
            video.append_data(frame)
    _check_mp4(path, len(animation.frames))


def _check_mp4(path: Path, frames: int) -> None:
    """Raises OSError for an incomplete video; imageio ignores the encoder's exit status."""
    from imageio_ffmpeg import count_frames_and_secs

    try:
        written, _ = count_frames_and_secs(str(path))
    except RuntimeError as error:
        raise OSError("the video encoder failed") from error
    if written < frames:
        raise OSError(f"the video encoder wrote {written} of {frames} frames")


_WRITERS: Mapping[str, Callable[[_Animation, Path], None]] = MappingProxyType({".gif": _write_gif, ".mp4": _write_mp4})
