"""Animations: the trajectories side by side, as a GIF or an MP4.

A frame is one panel per trajectory, with labels, errors, the time and a legend of the materials. A member of an
ensemble is drawn over the share of members that are at each place, and charts below show derived quantities.

A GIF has one palette for all frames, to avoid flicker.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from nmpm._support.progress import progress_bar
from nmpm.colours import BACKGROUND, FAINT_TEXT, INTERIOR, OBSTACLE, TEXT, WALL, Rgb, material_colours
from nmpm.errors import ConfigError
from nmpm.viz.camera import fit_camera
from nmpm.viz.charts import ChartStrip
from nmpm.viz.ensembles import band_colours, ensemble_colour
from nmpm.viz.output import check_output, replace_picture
from nmpm.viz.panel import PanelRenderer, format_time
from nmpm.viz.trajectories import LabelledTrajectories

PALETTE_SAMPLES = 5
"""Number of frames from which the palette of a GIF is chosen."""
PALETTE_SIZE = 64
"""Entries, including the transparent one. Files are a quarter smaller than with 256 and do not look worse."""
TRANSPARENT = PALETTE_SIZE - 1
"""Entry of pixels that keep their colour from the previous frame; no colour uses it."""
FIXED_COLOURS = (BACKGROUND, INTERIOR, WALL, TEXT, FAINT_TEXT)
BITS = 5
"""Bits per channel of the look-up table from colours to entries of the palette."""
LAST_FRAME_SECONDS = 1.0
"""How long a GIF shows its last frame before it starts again."""

# Lengths in pixels.
MARGIN = 10
PANEL_HEADER = 26
FOOTER = 26
STRIP_GAP = 8
ROOM_FOR_CHARTS = 300
LINE_HEIGHT = 22
FONT_SIZE = 13
LEGEND_DOT = 9


class FrameRenderer:
    """Draws whole animation frames.

    Panels are side by side in the order of the trajectories; if the box is much wider than high, they are stacked.
    Width and height are even, because video codecs require it.

    Args:
        trajectories: What to draw.
        side: Side of a square panel in pixels; stacked panels are wider.
    """

    def __init__(self, trajectories: LabelledTrajectories, side: int) -> None:
        self.trajectories = trajectories
        camera = fit_camera(trajectories)
        self._stacked = camera.width > 1.6 * camera.height
        stretch = min(3.0, math.sqrt(camera.width / camera.height)) if self._stacked else 1.0
        self._panel = PanelRenderer(trajectories, round(side * stretch))
        count = len(trajectories.positions)
        columns, rows = (1, count) if self._stacked else (count, 1)
        self._errors = trajectories.rms_errors()
        self._legend = material_colours(trajectories.materials) if len(trajectories.materials) > 1 else {}
        fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"  # those of the snapshots
        self._font = ImageFont.truetype(fonts / "DejaVuSans.ttf", FONT_SIZE)
        self._bold_font = ImageFont.truetype(fonts / "DejaVuSans-Bold.ttf", FONT_SIZE)
        self._title_height = LINE_HEIGHT if trajectories.title else 0
        panels_bottom = self._title_height + rows * (PANEL_HEADER + self._panel.height)
        width = MARGIN + columns * (self._panel.width + MARGIN)
        self.width = width + width % 2
        self._members = trajectories.members
        has_charts = bool(self._members) and trajectories.frame_count > 1 and self.width >= ROOM_FOR_CHARTS
        self._strip = ChartStrip(trajectories, self.width) if has_charts else None
        # The legend takes a second footer line if it does not fit beside the time.
        time = self._text_width(self._time_text(trajectories.frame_count - 1)) + 2 * MARGIN + 20
        legend = sum(self._text_width(name) + LEGEND_DOT + 19 for name in self._legend)
        self._legend_height = LINE_HEIGHT if self._legend and time + legend > self.width else 0
        self._strip_top = panels_bottom + STRIP_GAP
        footer_top = panels_bottom + (STRIP_GAP + self._strip.image.height if self._strip else 0)
        self._footer_baseline = footer_top + 18
        height = footer_top + FOOTER + self._legend_height
        self.height = height + height % 2
        self._template = self._draw_template()

    def draw(self, frame: int) -> NDArray[np.uint8]:
        """Draws one frame of the trajectories, (height, width, 3)."""
        image = self._template.copy()
        draw = ImageDraw.Draw(image)
        for index, (label, position) in enumerate(self.trajectories.positions.items()):
            left, top = self._corner(index)
            members = [member[frame] for member in self._members.values()] if label in self._members else []
            image.paste(Image.fromarray(self._panel.draw(position[frame], members)), (left, top))
            outside = self._panel.count_outside(position[frame])
            notes = [f"{outside} out of view"] if outside else []
            if label in self._errors:
                notes.append(f"RMS error {format_distance(self.trajectories, self._errors[label][frame])}")
            draw.text((left + self._panel.width, top - 6), ", ".join(notes), FAINT_TEXT, self._font, anchor="rs")
        if self._strip:
            image.paste(self._strip.draw(frame), (0, self._strip_top))
        draw.text((MARGIN, self._footer_baseline), self._time_text(frame), TEXT, self._font, anchor="ls")
        return np.asarray(image)

    @property
    def colours(self) -> list[Rgb]:
        """Those of materials and obstacles, and of an ensemble's bands."""
        materials = self.trajectories.materials
        bands = [ensemble_colour(materials), *band_colours(materials)] if self._members else []
        return [*material_colours(materials).values(), OBSTACLE, *bands]

    def _draw_template(self) -> Image.Image:
        """The parts that are the same in every frame: title, labels and legend."""
        image = Image.new("RGB", (self.width, self.height), BACKGROUND)
        draw = ImageDraw.Draw(image)
        draw.text((MARGIN, 18), self.trajectories.title, TEXT, self._bold_font, anchor="ls")
        for index, label in enumerate(self.trajectories.positions):
            left, top = self._corner(index)
            draw.text((left, top - 6), label, TEXT, self._bold_font, anchor="ls")
        right, baseline = self.width - MARGIN, self._footer_baseline + self._legend_height
        for name, colour in reversed(self._legend.items()):
            draw.text((right, baseline), name, TEXT, self._font, anchor="rs")
            right -= self._text_width(name) + LEGEND_DOT + 5
            draw.ellipse((right, baseline - LEGEND_DOT, right + LEGEND_DOT, baseline), fill=colour)
            right -= 14
        return image

    def _corner(self, index: int) -> tuple[int, int]:
        """Left and upper edge of a panel."""
        row, column = (index, 0) if self._stacked else (0, index)
        top = self._title_height + row * (PANEL_HEADER + self._panel.height) + PANEL_HEADER
        return MARGIN + column * (self._panel.width + MARGIN), top

    def _time_text(self, frame: int) -> str:
        return f"frame {frame} of {self.trajectories.frame_count - 1}   {format_time(self.trajectories, frame)}"

    def _text_width(self, text: str) -> int:
        return int(np.ceil(self._font.getlength(text)))


def format_distance(trajectories: LabelledTrajectories, length: float) -> str:
    """A distance in domain length, rounded to about a thousandth of the box, with the same number of decimals for every
    frame; in scientific notation from 100 box lengths on.
    """
    longest = max(high - low for low, high in trajectories.bounds)
    decimals = max(0, 3 - math.floor(math.log10(longest)))
    return f"{length:.{decimals}f}" if length < 100 * longest else f"{length:.1e}"


class GifPalette:
    """A fixed palette, with a look-up table from RGB colours to its entries.

    Args:
        samples: Some frames (H, W, 3) from which the palette is chosen.
        exact: Colours kept exactly however rare they are, in addition to those of background, walls and text.
    """

    def __init__(self, samples: Sequence[NDArray[np.uint8]], exact: Iterable[Rgb] = ()) -> None:
        kept = list(dict.fromkeys([*FIXED_COLOURS, *exact]))[: PALETTE_SIZE // 2]
        mosaic = Image.fromarray(np.concatenate(list(samples)))
        frequent = mosaic.quantize(TRANSPARENT - len(kept), method=Image.Quantize.MEDIANCUT).getpalette() or []
        self._colours = np.array(kept + np.reshape(frequent, (-1, 3)).tolist(), dtype=np.uint8)
        # The nearest entry to the centre of every table cell; the cell of a kept colour has that colour's entry.
        levels = (np.arange(1 << BITS, dtype=np.float32) + 0.5) * (1 << 8 - BITS)
        cells = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
        colours = self._colours.astype(np.float32)
        # |a - b|^2 without |a|^2, which does not change the nearest entry.
        distance = np.square(colours).sum(axis=1) - 2 * cells @ colours.T
        self._table = np.asarray(np.argmin(distance, axis=1), dtype=np.uint8)
        self._table[_table_index(np.array(kept, dtype=np.uint8))] = np.arange(len(kept))

    def quantize(self, frame: NDArray[np.uint8]) -> Image.Image:
        """Converts a frame (H, W, 3) to an image with this palette."""
        image = Image.fromarray(self._table[_table_index(frame)])
        padding = np.zeros((PALETTE_SIZE - len(self._colours), 3), dtype=np.uint8)
        image.putpalette(np.concatenate([self._colours, padding]).tobytes())
        return image


def _table_index(colours: NDArray[np.uint8]) -> NDArray[np.uint16]:
    red, green, blue = (colours[..., channel].astype(np.uint16) >> 8 - BITS for channel in range(3))
    return np.asarray(red << 2 * BITS | green << BITS | blue, dtype=np.uint16)


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
    if not 0 < fps <= 50:
        raise ConfigError(f"fps = {fps} must be above 0 and at most 50, the highest rate that viewers play.")
    if max_frames < 1 or not 64 <= side <= 4096:
        raise ConfigError(f"max_frames = {max_frames} must be at least 1, and side = {side} within 64 and 4096 pixels.")
    write = _write_mp4 if check_output(path, (".gif", ".mp4")) == ".mp4" else _write_gif
    frames = trajectories.evenly_spaced_frames(max_frames)
    renderer = FrameRenderer(trajectories, side)
    with replace_picture(path) as temporary:
        write(renderer, frames, fps, temporary)
    return path


def _draw_frames(renderer: FrameRenderer, frames: list[int]) -> Iterator[NDArray[np.uint8]]:
    """Draws the frames in order, with a progress bar."""
    with progress_bar("Drawing the animation", len(frames)) as step:
        for frame in frames:
            yield renderer.draw(frame)
            step()


def _write_gif(renderer: FrameRenderer, frames: list[int], fps: float, path: Path) -> None:
    indices = np.linspace(0, len(frames) - 1, PALETTE_SAMPLES).astype(int)
    samples = [renderer.draw(frames[index]) for index in dict.fromkeys(indices.tolist())]
    palette = GifPalette(samples, renderer.colours)
    first, *rest = (palette.quantize(frame) for frame in _draw_frames(renderer, frames))
    frame_time = round(100 / fps) * 10
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


def _write_mp4(renderer: FrameRenderer, frames: list[int], fps: float, path: Path) -> None:
    import imageio.v2 as imageio  # of the extra video, as its encoder is

    encoder: Any = imageio.get_writer(
        path, format="FFMPEG", mode="I", fps=fps, codec="libx264", quality=8, macro_block_size=2
    )
    with encoder as video:
        for frame in _draw_frames(renderer, frames):
            video.append_data(frame)
    # imageio ignores the encoder's exit status.
    from imageio_ffmpeg import count_frames_and_secs

    try:
        written, _ = count_frames_and_secs(str(path))
    except RuntimeError as error:
        raise OSError("the video encoder failed") from error
    if written < len(frames):
        raise OSError(f"the video encoder wrote {written} of {len(frames)} frames")
