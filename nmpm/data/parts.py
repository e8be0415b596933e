"""The files of finished trajectories in the folder of an unfinished dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from nmpm._support.atomic import atomic_write, temporary_files
from nmpm.data.archive_errors import NPZ_ERRORS
from nmpm.data.format import Trajectory
from nmpm.errors import DataError
from nmpm.sim import SimulatedTrajectory

PARTS = ".parts"
"""The folder of the parts, within the dataset's."""


def request_path(folder: Path) -> Path:
    """The request that the parts are simulated by, as JSON."""
    return folder / PARTS / "request.json"


def part_path(folder: Path, split: str, index: int) -> Path:
    """The part of one trajectory."""
    return folder / PARTS / f"{split}-{index:05d}.npz"


def write_part(path: Path, run: SimulatedTrajectory | Trajectory) -> None:
    """Writes a simulated trajectory, atomically."""
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, position=run.position, particle_type=run.particle_type, **run.attributes)


def remove_unfinished_parts(folder: Path, process: int) -> None:
    """Deletes what a process that was killed left of the part that it was writing."""
    for left in temporary_files(folder / PARTS, process):
        left.unlink(missing_ok=True)


def read_parts(paths: Iterable[Path], advance: Callable[[], object]) -> Iterator[Trajectory]:
    """Yields the trajectories one after the other; calls `advance` after each.

    Raises:
        DataError: if a part is damaged.
    """
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as arrays:
                attributes = {k: arrays[k][()] for k in sorted(set(arrays) - {"position", "particle_type"})}
                yield Trajectory(arrays["position"], arrays["particle_type"], attributes)
        except NPZ_ERRORS as error:
            raise DataError(
                f"{path}: damaged ({error}); delete it and repeat the call, which simulates it again."
            ) from error
        advance()


@contextmanager
def explain_write_errors(folder: Path) -> Iterator[None]:
    """Raises a DataError, which says how to continue, where writing to the folder fails."""
    try:
        yield
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written ({error}). Finished trajectories are kept; free space or correct the"
            " permissions, and repeat the call to continue."
        ) from error
