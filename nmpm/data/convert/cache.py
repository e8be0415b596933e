"""Converts datasets of other formats once, into the cache, so that they can be used like native ones."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from nmpm._support.atomic import lock_folder
from nmpm._support.shipped import user_home
from nmpm.data.convert import Options, convert, open_dataset
from nmpm.data.format import METADATA_FILE
from nmpm.data.gravity import check_gravity

_log = logging.getLogger(__name__)


def native_folder(path: Path, options: Options | None = None) -> Path:
    """A folder in the native layout with the same data, converted now or by an earlier call.

    The dataset is converted again when the size or time of a source file, or an option, has changed.

    Args:
        path: A file or folder of any format that `nmpm convert` reads.
        options: Facts that its files do not state.

    Raises:
        DataError: if the source cannot be read or the cache cannot be written.
        ConfigError: if the options contradict the gravity that the files state.
    """
    path, options = Path(path).resolve(), options or Options()
    if options.gravity is not None:
        stated = open_dataset(path, options=replace(options, gravity=None))
        if "gravity" not in stated.assumed:
            metadata = (path if path.is_dir() else path.parent) / METADATA_FILE
            check_gravity(options.gravity, stated.metadata.gravity, metadata if metadata.is_file() else path)
    cache = user_home() / "converted"
    folder = cache / f"{path.stem}-{_fingerprint(path, options)}"
    with lock_folder(cache):
        if not (folder / METADATA_FILE).is_file():
            for note in convert(path, folder, options=options):
                _log.info("%s: %s", path.name, note)
    return folder


def _fingerprint(path: Path, options: Options) -> str:
    ordered = replace(options, types=dict(sorted((options.types or {}).items())))
    static = sorted(options.static or ())
    identity = repr((str(path), replace(ordered, static=None), options.static is None, static, list(_stamps(path))))
    return hashlib.sha256(identity.encode()).hexdigest()[:10]


def _stamps(path: Path) -> Iterator[tuple[str, int, int]]:
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            status = file.stat()
            yield str(file.relative_to(path)), status.st_size, status.st_mtime_ns
