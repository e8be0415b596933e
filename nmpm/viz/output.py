"""Output files of pictures: checks before drawing, and writing through a temporary file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from nmpm._support.atomic import atomic_write
from nmpm._support.writable import file_obstacle
from nmpm.errors import ConfigError, DataError


def check_suffix(path: Path, supported: Iterable[str], purpose: str) -> str:
    """Returns the suffix of an output file in lower case.

    Raises:
        ConfigError: if the suffix is not supported.
    """
    suffix = path.suffix.lower()
    if suffix not in supported:
        raise ConfigError(f"Cannot write {purpose} to {path}: its name must end in {' or '.join(supported)}.")
    return suffix


def check_output(path: Path) -> None:
    """Checks, before anything is drawn, that a picture can be written to this path.

    Raises:
        ConfigError: if the file is an MP4 and the video encoder is not installed.
        DataError: if the folder does not exist or is not writable, or the path is a folder.
    """
    if path.suffix.lower() == ".mp4":
        _check_encoder()
    obstacle = file_obstacle(path)
    if obstacle:
        raise DataError(f"Cannot write {path}: {obstacle}")


def _check_encoder() -> None:
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise ConfigError(
            "MP4 needs a video encoder that is not installed: `pip install nmpm[video]`, or write a .gif instead."
        ) from error


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
