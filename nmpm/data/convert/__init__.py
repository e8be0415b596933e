"""Converts datasets of other formats into the native layout.

Each format is one class in one file, imported when it is needed; `READERS` lists them.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

from nmpm._support import __version__
from nmpm._support.atomic import lock_folder
from nmpm._support.shipped import user_home
from nmpm.data.convert.base import ForeignDataset as ForeignDataset
from nmpm.data.convert.base import Options as Options
from nmpm.data.convert.base import Reader as Reader
from nmpm.data.convert.base import is_selected
from nmpm.data.format import METADATA_FILE, SPLITS, Split, is_native, is_no_data, split_paths
from nmpm.data.gravity import check_gravity
from nmpm.errors import ConfigError, DataError, NmpmError
from nmpm.registry import Registry

_log = logging.getLogger(__name__)
_MOST_INNER = 100
"""Folders in a folder of no known format that are looked at."""

READERS: Registry[type[Reader]] = Registry(
    "nmpm.readers",
    "format",
    {
        "native": "nmpm.data.convert.native:Native",
        "deepmind": "nmpm.data.convert.deepmind:DeepMind",
        "gns-npz": "nmpm.data.convert.pickles:GnsNpz",
        "neuralmpm": "nmpm.data.convert.neuralmpm:NeuralMpm",
        "dmcf": "nmpm.data.convert.dmcf:Dmcf",
        "rollout-pickle": "nmpm.data.convert.pickles:RolloutPickle",
        "native-files": "nmpm.data.convert.native:NativeFiles",
        "h5md": "nmpm.data.convert.h5md:H5md",
        "arrays": "nmpm.data.convert.array_files:ArrayFiles",
        "array-frames": "nmpm.data.convert.array_files:ArrayFrames",
        "csv-frames": "nmpm.data.convert.tables:CsvFrames",
        "tracks": "nmpm.data.convert.tables:Tracks",
        "vtk": "nmpm.data.convert.vtk:Vtk",
        "vtkhdf": "nmpm.data.convert.vtkhdf:VtkHdf",
        "ply": "nmpm.data.convert.ply:Ply",
        "lammps": "nmpm.data.convert.lammps:Lammps",
        "xyz": "nmpm.data.convert.xyz:Xyz",
        "gsd": "nmpm.data.convert.gsd:Gsd",
        "tecplot": "nmpm.data.convert.tecplot:Tecplot",
    },
)
"""Readers of formats, in the order in which formats are detected."""


def summaries() -> dict[str, str]:
    """A line on each format; of a reader that cannot be imported, why."""
    lines = dict[str, str]()
    for name in READERS:
        try:
            lines[name] = READERS[name].summary
        except ConfigError as error:
            lines[name] = str(error)
    return lines


def open_dataset(path: Path, format_name: str | None = None, options: Options | None = None) -> ForeignDataset:
    """Opens a dataset of any format, of the one that is named or else detected.

    Raises:
        DataError: if the path is missing, of no known format, or damaged.
        ConfigError: if there is no format of that name, or an option is invalid.
    """
    path, options = Path(path), options or Options()
    if format_name is None:
        reader = _detect(path, options.files)
    else:
        reader = READERS[format_name]()
        if options.files is not None:
            reader = reader.select(options.files)
        reader = reader if reader.fixed_names or reader.recognises(path) else reader.with_any_name()
    dataset = reader.open(path, replace(options, resample=None, smooth=None))
    if options.dt is None and not options.changes_positions:
        return dataset
    from nmpm.data.convert.retiming import retime

    return retime(dataset, options)


def _detect(path: Path, files: str | None = None) -> Reader:
    """The reader of the first format that recognises a path, or those of its files whose names fit some patterns."""
    from nmpm.data.convert.nearest import describe_several, describe_unknown

    if not path.exists():
        raise DataError(f"{path}: no such file or folder.")
    if path.is_file() and not path.stat().st_size:
        raise DataError(f"{path}: the file is empty. Copy, download or write it again.")
    inside = sorted(path.glob("*")) if path.is_dir() else ()
    inner = list(islice((each for each in inside if each.is_dir() and not is_no_data(each.name)), _MOST_INNER))
    split_in = (folder for folder in inner if folder.name not in SPLITS)
    with_splits = [folder for folder in split_in if any(file.name.split(".")[0] in SPLITS for file in folder.glob("*"))]
    if len(with_splits) < 2:
        for reader in _readers_to_try(path, files):
            with suppress(NmpmError, OSError):
                if reader.recognises(path):
                    return reader
    if files is not None:
        raise DataError(f"{path}: --files {files}: no file of these names is of a format that is read.")
    datasets = list[Path]()
    for folder in inner:
        with suppress(NmpmError, OSError):
            _detect(folder)
            datasets.append(folder)
    raise DataError(describe_several(path, datasets) if datasets else describe_unknown(path))


def _readers_to_try(path: Path, files: str | None) -> Iterator[Reader]:
    """Readers that a file's name fits, or all for a folder; then those that go by the first bytes of files."""
    for by_content in (False, True):
        for kind in READERS.values():
            if (by_content and not kind.signature) or (files is not None and kind.fixed_names):
                continue
            reader = kind() if files is None else kind().select(files)
            if by_content:
                yield reader.with_any_name()
            elif not path.is_file() or is_selected(Path(path.name), kind.patterns):
                yield reader


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
    from nmpm.data.convert.conversion import renumber_types, write_native

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
    is_native_file = False  # with its scene described within or beside it
    if path.is_file():
        with suppress(DataError, IndexError):
            is_native_file = "scene" in Split(path).attributes(0) or (path.parent / METADATA_FILE).is_file()
    if is_native_file:
        if split is not None:
            raise ConfigError(f"--split {split}: {path} is the file of a split; leave it out, or name the folder.")
        if as_stored:
            return path
    paths = split_paths(path if is_native(path) and as_stored else native_folder(path, options))
    if split is not None and split not in paths:
        raise ConfigError(f"--split {split}: {path} has {', '.join(paths)}.")
    return paths[split] if split is not None else paths.get("test", next(iter(paths.values())))


@contextmanager
def open_complete(path: Path, format_name: str | None, options: Options) -> Iterator[ForeignDataset]:
    """As `open_dataset`, with runs whole; facts that are to be found in them are found by converting them first."""
    from nmpm.data.convert.conversion import NOTES, write_native

    dataset = open_dataset(path, format_name, options)
    if dataset.whole is not None:
        with TemporaryDirectory() as temporary:
            notes = write_native(dataset.whole, Path(temporary) / "whole")
            yield replace(open_dataset(Path(temporary) / "whole"), notes=notes)
    elif dataset.unknown:
        native = open_dataset(native_folder(path, options, format_name))
        yield replace(native, notes=tuple(native.metadata.extra.get(NOTES, ())))
    else:
        yield dataset


def _fingerprint(path: Path, options: Options, format_name: str | None) -> str:
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    states = [(str(file.relative_to(path)), file.stat()) for file in files if file.is_file()]
    stamps = [(name, state.st_size, state.st_mtime_ns) for name, state in states]
    # Mappings and sets of equal content may have another order.
    ordered = [sorted(dict(value).items()) if isinstance(value, Mapping) else value for value in vars(options).values()]
    ordered = [sorted(value) if isinstance(value, frozenset) else value for value in ordered]
    identity = repr((__version__, str(path), ordered, stamps, format_name))
    return hashlib.sha256(identity.encode()).hexdigest()[:10]
