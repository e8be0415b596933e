"""Writes trajectories for other programs: a form is one class in one file, by the suffix of the file's name.

`WRITERS` lists them; they are imported when they write, so that help and refusals need not wait for HDF5.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from nmpm._support.progress import progress_bar
from nmpm.data.write.base import TrajectoryWriter as TrajectoryWriter
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.data.format import Metadata, Trajectory

WRITERS = MappingProxyType(
    {
        ".h5": "hdf5.NativeHdf5",
        ".vtkhdf": "hdf5.VtkHdf",
        ".vtp": "vtp.VtpSeries",
        ".pvd": "vtp.VtpSeries",
        ".usda": "usd.Usda",
        ".lammpstrj": "lammps.LammpsDump",
        ".npz": "npz.Npz",
        ".csv": "csv.Csv",
    }
)
"""Module of this folder and class of the writer, by suffix in lower case."""
SUFFIXES = ", ".join(suffix for suffix in WRITERS if suffix != ".pvd")


def is_written_by_suffix(path: Path) -> bool:
    """Whether there is a writer for a path's suffix."""
    return path.suffix.lower() in WRITERS


def find_writer(option: str, path: Path) -> TrajectoryWriter:
    """The writer for a path's suffix.

    Raises:
        ConfigError: naming the option, if there is none for the suffix, or the file cannot be written.
    """
    if not is_written_by_suffix(path):
        raise ConfigError(f"{option} {path}: nothing is written by that suffix; there are {SUFFIXES}.")
    module, name = WRITERS[path.suffix.lower()].split(".")
    writer: TrajectoryWriter = getattr(import_module(f"{__name__}.{module}"), name)()
    if obstacle := writer.obstacle(path):
        raise ConfigError(f"{option} {path}: {obstacle}")
    return writer


def write_trajectory(path: Path, trajectory: Trajectory, metadata: Metadata) -> Path:
    """Writes a trajectory in the form of the path's suffix; returns the file to open, see `TrajectoryWriter.write`."""
    with progress_bar(f"Writing {path.name}", len(trajectory.position)) as step:
        return find_writer("the file", path).write(path, trajectory, metadata, step)


def write_trajectories(path: Path, trajectories: Iterable[Trajectory], metadata: Metadata, frames: int) -> list[Path]:
    """As `write_trajectory`, several of so many frames in all; the files are `TrajectoryWriter.paths`."""
    with progress_bar(f"Writing {path.name}", frames) as step:
        return find_writer("the file", path).write_all(path, trajectories, metadata, step)
