"""Detects formats, and streams opened datasets into the native layout."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from nmpm._support.atomic import new_folder
from nmpm._support.progress import progress_bar
from nmpm.data.convert.base import DatasetFormat, ForeignDataset
from nmpm.data.convert.conversion_log import ConversionLog
from nmpm.data.format import SPLITS, Trajectory, write_metadata, write_split
from nmpm.data.statistics import MotionStatistics
from nmpm.errors import ConfigError, DataError

NOTES = "conversion"


def detect_format(path: Path, formats: Sequence[DatasetFormat]) -> DatasetFormat:
    """Detects the format of a file or folder.

    Raises:
        DataError: if the path is missing, or looks like none of the formats.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file or folder.")
    found = next((kind for kind in formats if kind.recognises(path)), None)
    if found is None:
        content = ", ".join(sorted(item.name for item in path.iterdir())[:8]) if path.is_dir() else "a file"
        raise DataError(
            f"{path}: no known format ({', '.join(kind.name for kind in formats)}); found"
            f" {content or 'nothing'}. State the --format, or write the arrays with nmpm.write_trajectories."
        )
    return found


def find_format(name: str, formats: Sequence[DatasetFormat]) -> DatasetFormat:
    """The format with a name.

    Raises:
        ConfigError: if there is no such format; lists the known ones.
    """
    for kind in formats:
        if kind.name == name:
            return kind
    raise ConfigError(f"No format is called {name!r}; known: {', '.join(kind.name for kind in formats)}.")


def write_native(source: ForeignDataset, destination: Path) -> tuple[str, ...]:
    """Writes an opened dataset in the native layout.

    Args:
        source: The dataset.
        destination: A folder that does not exist yet, or is empty.

    Returns:
        The source's notes, and those of the conversion.

    Raises:
        DataError: if the destination exists or cannot be written, or the source is damaged; nothing is left then.
    """
    destination = Path(destination)
    if destination.exists() and (not destination.is_dir() or any(destination.iterdir())):
        raise DataError(f"{destination}: exists already; choose another folder, or delete this one.")
    try:
        with new_folder(destination) as part:
            return _write(source, part)
    except OSError as error:
        raise DataError(f"{destination}: cannot be written ({error}).") from error


def _write(source: ForeignDataset, folder: Path) -> tuple[str, ...]:
    names = [name for name in SPLITS if name in source.splits]
    known = [source.counts.get(name) for name in names]
    total = None if None in known else sum(count or 0 for count in known)
    log = ConversionLog(source.metadata, MotionStatistics(source.metadata))
    with progress_bar("Converting", total) as advance:
        for name in names:
            write_split(folder / f"{name}.h5", _log_and_yield(source.splits[name], log, f"{name} split", advance))
            # The statistics are those of the first split, train where there is one.
            log.statistics_done = True
    metadata, inconsistencies = log.final_metadata()
    write_metadata(folder, replace(metadata, extra=metadata.extra | {NOTES: [*source.notes, *inconsistencies]}))
    return (*source.notes, *inconsistencies, *log.out_of_bounds_notes())


def _log_and_yield(
    trajectories: Iterable[Trajectory], log: ConversionLog, where: str, advance: Callable[[], object]
) -> Iterator[Trajectory]:
    for index, trajectory in enumerate(trajectories):
        log.add(trajectory, f"{where}, trajectory {index}")
        yield trajectory
        advance()
