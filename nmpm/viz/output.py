"""Output files of pictures: checks before drawing, and writing through a temporary file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from nmpm._support.atomic import atomic_write, file_obstacle
from nmpm._support.messages import install
from nmpm.errors import ConfigError, DataError


class PictureStyle(NamedTuple):
    """What a picture is for.

    Args:
        suffix: Of its file.
        columns: Frames of snapshots.
        size: Width and height of a chart in inches.
        font_size: Of a chart, in points.
    """

    suffix: str
    columns: int
    size: tuple[float, float]
    font_size: float


STYLES: Mapping[str, PictureStyle] = MappingProxyType(
    {
        "talk": PictureStyle(".svg", columns=3, size=(9.0, 5.06), font_size=14.0),
        "paper": PictureStyle(".pdf", columns=6, size=(6.5, 4.2), font_size=8.0),
    }
)
"""Few and large things on a slide of 16:9, an SVG; the width of a page's text, a PDF."""


def check_output(path: Path, suffixes: Sequence[str]) -> str:
    """Returns the suffix in lower case; checks, before anything is drawn, that a file can be written to this path.

    Raises:
        ConfigError: if the suffix is not among these, or the file is an MP4 and the video encoder is not installed.
        DataError: if the folder does not exist or is not writable, or the path is a folder.
    """
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise ConfigError(f"Cannot write {path}: its name must end in {' or '.join(suffixes)}.")
    if suffix == ".mp4":
        try:
            from imageio_ffmpeg import get_ffmpeg_exe

            get_ffmpeg_exe()
        except (ImportError, RuntimeError) as error:
            raise ConfigError(
                f"MP4 needs a video encoder that is not installed: {install('video')}; or write a .gif instead."
            ) from error
    if obstacle := file_obstacle(path):
        raise DataError(f"Cannot write {path}: {obstacle}")
    return suffix


@contextmanager
def replace_picture(path: Path) -> Iterator[Path]:
    """Yields a temporary path, renamed to `path` on success and deleted after any exception.

    Raises:
        DataError: if writing fails, for example because the disk is full.
    """
    try:
        with atomic_write(path) as temporary:
            yield temporary
    except OSError as error:
        # The encoder's message continues with its whole command line.
        reason = error.strerror or str(error).partition("\n")[0]
        raise DataError(f"Cannot write {path}: {reason}. The file was left as it was before.") from error
