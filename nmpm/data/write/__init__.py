"""Writes trajectories for other programs: a form is one class in one file, by the suffix of the file's name.

`WRITERS` lists them.
"""

from __future__ import annotations

from pathlib import Path

from nmpm._support.progress import progress_bar
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.write.base import TrajectoryWriter as TrajectoryWriter
from nmpm.data.write.csv import Csv
from nmpm.data.write.hdf5 import NativeHdf5, VtkHdf
from nmpm.data.write.lammps import LammpsDump
from nmpm.data.write.npz import Npz
from nmpm.data.write.usd import Usda
from nmpm.data.write.vtp import VtpSeries
from nmpm.errors import ConfigError

WRITERS: tuple[TrajectoryWriter, ...] = (NativeHdf5(), VtkHdf(), VtpSeries(), Usda(), LammpsDump(), Npz(), Csv())
SUFFIXES = ", ".join(writer.suffixes[0] for writer in WRITERS)


def is_written_by_suffix(path: Path) -> bool:
    """Whether there is a writer for a path's suffix."""
    return any(path.suffix.lower() in writer.suffixes for writer in WRITERS)


def find_writer(option: str, path: Path) -> TrajectoryWriter:
    """The writer for a path's suffix.

    Raises:
        ConfigError: naming the option, if there is none for the suffix, or the file cannot be written.
    """
    for writer in WRITERS:
        if path.suffix.lower() in writer.suffixes:
            if obstacle := writer.obstacle(path):
                raise ConfigError(f"{option} {path}: {obstacle}")
            return writer
    raise ConfigError(f"{option} {path}: nothing is written by that suffix; there are {SUFFIXES}.")


def write_trajectory(path: Path, trajectory: Trajectory, metadata: Metadata) -> Path:
    """Writes a trajectory in the form of the path's suffix; returns the file to open, see `TrajectoryWriter.write`."""
    with progress_bar(f"Writing {path.name}", len(trajectory.position)) as step:
        return find_writer("the file", path).write(path, trajectory, metadata, step)
