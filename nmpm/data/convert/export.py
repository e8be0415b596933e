"""Writes trajectories of a dataset of any format as files for other programs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

from nmpm._support.atomic import new_folder
from nmpm._support.progress import progress_bar
from nmpm.data.convert import native_folder, open_dataset
from nmpm.data.convert.base import ForeignDataset, Options
from nmpm.data.convert.conversion import NOTES, write_native
from nmpm.data.format import ID, Trajectory
from nmpm.data.write import TrajectoryWriter, find_writer, write_trajectory
from nmpm.data.write.frames import fields_left_out
from nmpm.errors import ConfigError, DataError


@dataclass(frozen=True)
class Exported:
    """What an export wrote: a file to open, or a folder of so many of them, and notes for the user."""

    path: Path
    files: int
    notes: tuple[str, ...]


@contextmanager
def open_complete(path: Path, format_name: str | None, options: Options) -> Iterator[ForeignDataset]:
    """As `open_dataset`, with runs whole; facts that are to be found in them are found by converting them first."""
    dataset = open_dataset(path, format_name, options)
    if dataset.whole is not None:
        with TemporaryDirectory() as temporary:
            notes = write_native(dataset.whole, Path(temporary) / "whole")
            yield replace(open_dataset(Path(temporary) / "whole"), notes=notes)
    elif dataset.unknown or None in dataset.counts.values():
        native = open_dataset(native_folder(path, options, format_name))
        yield replace(native, notes=tuple(native.metadata.extra.get(NOTES, ())))
    else:
        yield dataset


def export(dataset: ForeignDataset, destination: Path, split: str | None, index: int | None) -> Exported:
    """Writes one trajectory to a file, or all into a folder with the file's name but its suffix.

    Args:
        dataset: With all facts.
        destination: Its suffix states the form.
        split: All splits when left out; with an index, the tests or else the first.
        index: Of the trajectory; all when left out.

    Raises:
        ConfigError: if there is no such form, split or trajectory.
        DataError: if a trajectory cannot be read, or the folder exists.
    """
    writer, splits = find_writer("DESTINATION", destination), list(dataset.splits)
    if split is not None and split not in splits:
        raise ConfigError(f"--split {split}: the dataset has {', '.join(splits)}.")
    if split is None and index is not None:
        split = "test" if "test" in splits else splits[0]
    chosen = splits if split is None else [split]
    counts = {name: dataset.counts[name] or 0 for name in chosen}
    if index is None and sum(counts.values()) != 1:
        return _export_all(dataset, destination, writer, counts)
    index, name = index or 0, chosen[0]
    if index >= counts[name]:
        raise ConfigError(f"--trajectory {index}: the {name} split has trajectories 0 … {counts[name] - 1}.")
    trajectory = next(islice(dataset.splits[name](), index, None))
    return Exported(
        write_trajectory(destination, trajectory, dataset.metadata), 1, _notes(_left_out(writer, trajectory))
    )


def _export_all(
    dataset: ForeignDataset, destination: Path, writer: TrajectoryWriter, counts: dict[str, int]
) -> Exported:
    folder, left_out = destination.with_suffix(""), set[str]()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(
            f"{folder}: exists already; {sum(counts.values())} trajectories would become files in it. Choose another"
            " name, or one trajectory by --trajectory N."
        )
    with new_folder(folder) as new, progress_bar("Writing", sum(counts.values())) as step:
        for path, trajectory in _files(dataset, new, destination.suffix, counts):
            path.parent.mkdir(exist_ok=True)
            writer.write(path, trajectory, dataset.metadata)
            left_out |= _left_out(writer, trajectory)
            step()
    return Exported(folder, sum(counts.values()), _notes(left_out))


def _files(
    dataset: ForeignDataset, folder: Path, suffix: str, counts: dict[str, int]
) -> Iterator[tuple[Path, Trajectory]]:
    for name in counts:
        for index, trajectory in enumerate(dataset.splits[name]()):
            yield folder / name / f"{index:05d}{suffix}", trajectory


def _left_out(writer: TrajectoryWriter, trajectory: Trajectory) -> set[str]:
    """Fields that a form does not hold."""
    if writer.holds_all_fields:
        return set()
    return set(fields_left_out(trajectory)) - ({ID} if writer.holds_text_ids else set())


def _notes(left_out: set[str]) -> tuple[str, ...]:
    if not left_out:
        return ()
    return (f"Not numbers of particles, so left out: {', '.join(sorted(left_out))}; .npz and .h5 hold all fields.",)
