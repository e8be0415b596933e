"""Converts datasets of other formats into the native layout.

Each format is one class in one file; `FORMATS` lists them in the order in which they are detected.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path

from nmpm._support.atomic import lock_folder
from nmpm._support.shipped import user_home
from nmpm._support.version import __version__
from nmpm.data.convert.array_files import ArrayFiles
from nmpm.data.convert.array_frames import ArrayFrames
from nmpm.data.convert.base import DatasetFormat as DatasetFormat
from nmpm.data.convert.base import ForeignDataset as ForeignDataset
from nmpm.data.convert.base import Options as Options
from nmpm.data.convert.conversion import renumber_types, write_native
from nmpm.data.convert.csv_frames import CsvFrames
from nmpm.data.convert.deepmind import DeepMind
from nmpm.data.convert.dmcf import Dmcf
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.gns_npz import GnsNpz
from nmpm.data.convert.gsd import Gsd
from nmpm.data.convert.h5md import H5md
from nmpm.data.convert.lammps import Lammps
from nmpm.data.convert.native import Native, NativeFiles
from nmpm.data.convert.nearest import describe_several, describe_unknown, has_splits, subfolders
from nmpm.data.convert.neuralmpm import NeuralMpm
from nmpm.data.convert.ply import Ply
from nmpm.data.convert.retiming import retime
from nmpm.data.convert.rollout_pickle import RolloutPickle
from nmpm.data.convert.tecplot import Tecplot
from nmpm.data.convert.tracks import Tracks
from nmpm.data.convert.vtk import Vtk
from nmpm.data.convert.vtkhdf import VtkHdf
from nmpm.data.convert.xyz import Xyz
from nmpm.data.format import METADATA_FILE, Split, is_native
from nmpm.data.gravity import check_gravity
from nmpm.data.split_files import split_paths
from nmpm.errors import ConfigError, DataError, NmpmError

_log = logging.getLogger(__name__)
_MOST_INNER = 100
"""Folders in a folder of no known format that are looked at."""

FORMATS: tuple[DatasetFormat, ...] = (
    Native(),
    DeepMind(),
    GnsNpz(),
    NeuralMpm(),
    Dmcf(),
    RolloutPickle(),
    NativeFiles(),
    H5md(),
    ArrayFiles(),
    ArrayFrames(),
    CsvFrames(),
    Tracks(),
    Vtk(),
    VtkHdf(),
    Ply(),
    Lammps(),
    Xyz(),
    Gsd(),
    Tecplot(),
)


def open_dataset(path: Path, format_name: str | None = None, options: Options | None = None) -> ForeignDataset:
    """Opens a dataset of any format, of the one that is named or else detected.

    Raises:
        DataError: if the path is missing, of no known format, or damaged.
        ConfigError: if there is no format of that name, or an option is invalid.
    """
    options = options or Options()
    as_stored = replace(options, resample=None, smooth=None)
    dataset = _find_format(Path(path), format_name, options.files).open(Path(path), as_stored)
    return retime(replace(dataset, unknown=dataset.unknown - as_stored.stated), options)


def _find_format(path: Path, name: str | None, files: str | None = None) -> DatasetFormat:
    """The format of that name, or else the first that recognises the path; for those files alone that are selected."""
    formats = FORMATS if files is None else tuple(kind.select(files) for kind in FORMATS if kind.patterns)
    names = ", ".join(kind.name for kind in FORMATS)
    if name is not None:
        for kind in formats:
            if kind.name == name:
                return kind if kind.patterns == () or kind.recognises(path) else kind.with_any_name()
        raise ConfigError(f"No format is called {name!r}; known: {names}.")
    if not path.exists():
        raise DataError(f"{path}: no such file or folder.")
    if path.is_file() and not path.stat().st_size:
        raise DataError(f"{path}: the file is empty. Copy, download or write it again.")
    inner = list(islice(subfolders(path), _MOST_INNER))
    if sum(map(has_splits, inner)) < 2:
        for kind in formats:
            with suppress(NmpmError, OSError):
                if kind.recognises(path):
                    return kind
        for kind in formats:
            by_content = kind.with_any_name()
            with suppress(NmpmError, OSError):
                if isinstance(kind, FrameFormat) and kind.signature and by_content.recognises(path):
                    return by_content
    if files is not None:
        raise DataError(f"{path}: --files {files}: no file of these names is of a format that is read.")
    datasets = [folder for folder in inner if _is_dataset(folder)]
    raise DataError(describe_several(path, datasets) if datasets else describe_unknown(path))


def _is_dataset(folder: Path) -> bool:
    """Whether a folder is of a known format, as a whole."""
    with suppress(NmpmError, OSError):
        return bool(_find_format(folder, None))
    return False


def convert(
    source: Path,
    destination: Path,
    format_name: str | None = None,
    options: Options | None = None,
    ids: Mapping[int, int] | None = None,
    problems: list[str] | None = None,
) -> tuple[str, ...]:
    """Converts a dataset of any format into the native layout; after an error nothing is left.

    Args:
        source: A file or folder.
        destination: A folder that does not exist yet, or is empty.
        format_name: Name of the source's format; detected when left out.
        options: Facts that the files do not state.
        ids: New particle type ids by old ones; other ids stay.
        problems: As for `write_native`.

    Returns:
        Notes on assumptions and inconsistencies, as sentences.

    Raises:
        DataError: if the source is missing, damaged or of no known format, or the destination exists.
        ConfigError: if there is no format of that name, or an option is invalid.
    """
    dataset = open_dataset(source, format_name, options)
    return write_native(renumber_types(dataset, ids) if ids else dataset, destination, problems)


def native_folder(path: Path, options: Options | None = None, format_name: str | None = None) -> Path:
    """A folder in the native layout with the same data, converted in the cache now or by an earlier call.

    The dataset is converted again when the size or time of a source file, an option or the version of nmpm has changed.

    Raises:
        DataError: if the source cannot be read or the cache cannot be written.
        ConfigError: if the options contradict the gravity that the files state.
    """
    path, options = Path(path).resolve(), options or Options()
    if options.gravity is not None:
        stated = open_dataset(path, format_name, replace(options, gravity=None))
        if "gravity" not in stated.assumed | stated.unknown:
            metadata = (path if path.is_dir() else path.parent) / METADATA_FILE
            check_gravity(options.gravity, stated.metadata.gravity, metadata if metadata.is_file() else path)
    cache = user_home() / "converted"
    folder = cache / f"{path.stem}-{_fingerprint(path, options, format_name)}"
    with lock_folder(cache):
        if not (folder / METADATA_FILE).is_file():
            for note in convert(path, folder, format_name, options):
                _log.info("%s: %s", path.name, note)
    return folder


def native_file(path: Path, split: str | None = None, options: Options | None = None) -> Path:
    """A file in the native layout with a split of the same data: the path itself, or one of `native_folder`.

    Args:
        path: A file or folder of any format.
        split: The tests, or else the first, when left out.
        options: As for `native_folder`.

    Raises:
        DataError: if the data cannot be read.
        ConfigError: if they have no such split.
    """
    as_stored = options is None or not options.changes_positions
    if _is_native_file(path):
        if split is not None:
            raise ConfigError(f"--split {split}: {path} is the file of a split; leave it out, or name the folder.")
        if as_stored:
            return path
    paths = split_paths(path if is_native(path) and as_stored else native_folder(path, options))
    if split is not None and split not in paths:
        raise ConfigError(f"--split {split}: {path} has {', '.join(paths)}.")
    return paths[split] if split is not None else paths.get("test", next(iter(paths.values())))


def _is_native_file(path: Path) -> bool:
    """Whether a file has the native layout, with its scene described within or beside it."""
    if not path.is_file():
        return False
    try:
        described = "scene" in Split(path).attributes(0)
    except (DataError, IndexError):
        return False
    return described or (path.parent / METADATA_FILE).is_file()


def _fingerprint(path: Path, options: Options, format_name: str | None) -> str:
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    states = [(str(file.relative_to(path)), file.stat()) for file in files if file.is_file()]
    stamps = [(name, state.st_size, state.st_mtime_ns) for name, state in states]
    # Mappings and sets of equal content may have another order.
    ordered = [
        sorted(value.items() if isinstance(value, Mapping) else value)
        if isinstance(value, Mapping | frozenset)
        else value
        for value in vars(options).values()
    ]
    identity = repr((__version__, str(path), ordered, stamps, format_name))
    return hashlib.sha256(identity.encode()).hexdigest()[:10]
