"""Writes trajectories for other programs: a form is one class, by the suffix of the file's name.

`WRITERS` lists them; they are imported when they write, so that help and refusals need not wait for HDF5.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from nmpm._support.progress import progress_bar
from nmpm.errors import ConfigError
from nmpm.registry import Registry

if TYPE_CHECKING:
    from nmpm.data.format import Metadata, Trajectory
    from nmpm.data.write.base import TrajectoryWriter

WRITERS: Registry[type[TrajectoryWriter]] = Registry(
    "nmpm.writers",
    "writer",
    {
        ".h5": "nmpm.data.write.vtk:NativeHdf5",
        ".vtkhdf": "nmpm.data.write.vtk:NativeVtkHdf",
        ".vtp": "nmpm.data.write.vtk:VtpSeries",
        ".pvd": "nmpm.data.write.vtk:VtpSeries",
        ".usda": "nmpm.data.write.usd:Usda",
        ".lammpstrj": "nmpm.data.write.text:LammpsDump",
        ".npz": "nmpm.data.write.text:Npz",
        ".csv": "nmpm.data.write.text:Csv",
    },
)
"""Subclasses of `TrajectoryWriter` by suffix in lower case."""


def suffixes() -> str:
    """The suffixes that are written, for help and messages."""
    return ", ".join(suffix for suffix in WRITERS if suffix != ".pvd")


def is_written_by_suffix(path: Path) -> bool:
    """Whether there is a writer for a path's suffix."""
    return path.suffix.lower() in WRITERS


def find_writer(option: str, path: Path) -> TrajectoryWriter:
    """The writer for a path's suffix.

    Raises:
        ConfigError: naming the option, if there is none for the suffix, or the file cannot be written.
    """
    if not is_written_by_suffix(path):
        raise ConfigError(f"{option} {path}: nothing is written by that suffix; there are {suffixes()}.")
    writer = WRITERS[path.suffix.lower()]()
    if obstacle := writer.obstacle(path):
        raise ConfigError(f"{option} {path}: {obstacle}")
    return writer


def write_trajectory(path: Path, trajectory: Trajectory, metadata: Metadata) -> Path:
    """Writes a trajectory in the form of the path's suffix; returns the file to open, see `TrajectoryWriter.write`."""
    from nmpm.data.write.base import Clip

    with progress_bar(f"Writing {path.name}", len(trajectory.position)) as step:
        return find_writer("the file", path).write(path, Clip(trajectory, metadata, step))


def write_trajectories(path: Path, trajectories: Iterable[Trajectory], metadata: Metadata, frames: int) -> list[Path]:
    """As `write_trajectory`, several of so many frames in all; the files are `TrajectoryWriter.paths`."""
    from nmpm.data.write.base import Clip

    with progress_bar(f"Writing {path.name}", frames) as step:
        clips = (Clip(trajectory, metadata, step) for trajectory in trajectories)
        return find_writer("the file", path).write_all(path, clips)
