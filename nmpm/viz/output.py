"""Output files of pictures: checks before drawing, writing through a temporary file, and self-contained pages."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from nmpm._support.atomic import atomic_write, file_obstacle
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


def fill_page(folder: Traversable, scripts: Sequence[str], data: Any) -> str:
    """A page without links: `page.html` with `style.css`, the scripts and the data in the places that it marks.

    Args:
        folder: Holds these files.
        scripts: Names of the scripts, in order.
        data: What JSON can hold; the page reads it from its element `data`.
    """
    # `</script>` in a text would end the data.
    packed = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    script = "\n".join(folder.joinpath(name).read_text(encoding="utf-8") for name in scripts)
    style = folder.joinpath("style.css").read_text(encoding="utf-8")
    page = folder.joinpath("page.html").read_text(encoding="utf-8")
    for mark, content in {"/*STYLE*/": style, "/*SCRIPT*/": script, "/*DATA*/": packed}.items():
        before, after = page.split(mark)
        page = before + content + after
    return page
