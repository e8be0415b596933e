"""Foreign datasets into the native layout: all of it or nothing, streamed, and with what was odd about it said."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nmpm.data.convert.base import UNSTATED, Format, Source
from nmpm.data.format import SPLITS, Metadata, Trajectory, write_metadata, write_split
from nmpm.data.progress import shown
from nmpm.data.statistics import KEYS, Statistics, disagreements, first_that_moves
from nmpm.errors import ConfigError, DataError

STATED = "stated_statistics"
MOVING_BOUNDARIES = "moving_boundaries"
NOTES = "conversion"


def detect(path: Path, formats: Sequence[Format]) -> Format:
    """The format of a file or folder.

    Raises:
        DataError: if there is nothing, or it looks like none of the formats.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file or folder.")
    found = next((kind for kind in formats if kind.recognises(path)), None)
    if found is None:
        held = ", ".join(sorted(item.name for item in path.iterdir())[:8]) if path.is_dir() else "a file"
        raise DataError(
            f"{path}: of no format that is known ({', '.join(kind.name for kind in formats)}); found"
            f" {held or 'nothing'}. Name the --format, or bring the arrays by nmpm.write_trajectories."
        )
    return found


def named(name: str, formats: Sequence[Format]) -> Format:
    """The format of that name.

    Raises:
        ConfigError: if there is none.
    """
    for kind in formats:
        if kind.name == name:
            return kind
    raise ConfigError(f"No format is called {name!r}; known: {', '.join(kind.name for kind in formats)}.")


def write_source(source: Source, destination: Path) -> tuple[str, ...]:
    """Writes an opened dataset in the native layout.

    Args:
        source: The dataset.
        destination: A folder that does not exist yet, or is empty.

    Returns:
        The source's notes, and what was seen while writing.

    Raises:
        DataError: if the destination is taken or cannot be written, or the source is damaged; nothing is left then.
    """
    destination = Path(destination)
    if destination.exists() and (not destination.is_dir() or any(destination.iterdir())):
        raise DataError(f"{destination}: is there already; choose another folder, or delete this one.")
    try:
        with _appearing(destination) as part:
            return _write(source, part)
    except OSError as error:
        raise DataError(f"{destination}: cannot be written ({error}).") from error


@contextmanager
def _appearing(folder: Path) -> Iterator[Path]:
    """A folder beside the given one, which becomes it once all went well and is gone otherwise."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    for stale in folder.parent.glob(f".{folder.name}.*.part"):
        if not _alive(stale.name.split(".")[-2]):
            shutil.rmtree(stale, ignore_errors=True)
    part = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    try:
        yield part
        os.replace(part, folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _alive(process: str) -> bool:
    with suppress(ProcessLookupError, ValueError):
        try:
            os.kill(int(process), 0)
        except PermissionError:
            return True
        return True
    return False


def _write(source: Source, folder: Path) -> tuple[str, ...]:
    names = [name for name in SPLITS if name in source.splits]
    known = [source.counts.get(name) for name in names]
    total = None if None in known else sum(count or 0 for count in known)
    seen = _Seen(source.metadata, Statistics(source.metadata))
    with shown("Converting", total) as advance:
        for name in names:
            write_split(folder / f"{name}.h5", _watched(source.splits[name], seen, f"{name} split", advance))
            # Statistics are those of the first split, train where there is one.
            seen.statistics_done = True
    metadata, odd = seen.concluded()
    write_metadata(folder, replace(metadata, extra=metadata.extra | {NOTES: [*source.notes, *odd]}))
    return (*source.notes, *odd, *seen.outside())


def _watched(
    trajectories: Iterable[Trajectory], seen: _Seen, where: str, advance: Callable[[], None]
) -> Iterator[Trajectory]:
    for index, trajectory in enumerate(trajectories):
        seen.add(trajectory, f"{where}, trajectory {index}")
        yield trajectory
        advance()


@dataclass
class _Seen:
    """What is learnt of the trajectories that pass by."""

    metadata: Metadata
    statistics: Statistics
    statistics_done: bool = False
    moving_boundaries: int = 0
    number: int = 0
    lower: np.ndarray | None = None
    upper: np.ndarray | None = None
    frames: frozenset[int] = frozenset()
    particles: int = 0

    def add(self, trajectory: Trajectory, where: str) -> None:
        types, position = trajectory.particle_type, trajectory.position
        if position.shape[2] != self.metadata.dim:
            raise DataError(f"{where}: positions have {position.shape[2]} axes, the metadata say {self.metadata.dim}.")
        self.metadata.check_types(types, where)
        if not self.statistics_done:
            self.statistics.add(trajectory)
        self.number += 1
        static = np.isin(types, list(self.metadata.static_types))
        self.moving_boundaries += first_that_moves(position, static, self.metadata.bounds) is not None
        present = np.isin(types, [*self.metadata.moving_types, *self.metadata.static_types])
        if present.any():
            low, high = position[:, present].min(axis=(0, 1)), position[:, present].max(axis=(0, 1))
            self.lower = low if self.lower is None else np.minimum(self.lower, low)
            self.upper = high if self.upper is None else np.maximum(self.upper, high)
        self.frames |= {len(position)}
        self.particles = max(self.particles, position.shape[1])

    def concluded(self) -> tuple[Metadata, list[str]]:
        """The metadata with what was measured, and notes on what is odd."""
        extra, measured = dict(self.metadata.extra), self.statistics.result()
        stated = {key: extra[key] for key in KEYS if key in extra}
        notes = disagreements(measured, stated)
        if notes:
            notes.append(f"Those stated are kept as {STATED!r}.")
        if stated:
            extra[STATED] = stated
        extra |= measured | {"num_particles_max": self.particles}
        if self.moving_boundaries:
            extra[MOVING_BOUNDARIES] = True
            notes.append(
                f"Particles of a static type move in {self.moving_boundaries} of {self.number} trajectories. Their"
                " positions are kept; to train on them, declare which types are static (--static)."
            )
        length = self.metadata.sequence_length or max(self.frames, default=2) - 1
        return replace(self.metadata, extra=extra, sequence_length=length), notes + self._lengths()

    def outside(self) -> list[str]:
        """Where positions leave the stated bounds."""
        if self.lower is None or self.upper is None:
            return []
        stated_low, stated_high = np.asarray(self.metadata.bounds).T
        walls = ~np.asarray(self.metadata.periodic)
        beyond = ((self.lower < stated_low) | (self.upper > stated_high)) & walls
        return [
            f"Along {'xyz'[axis]} positions reach from {self.lower[axis]:.4g} to {self.upper[axis]:.4g}, beyond the"
            f" stated bounds {list(self.metadata.bounds[axis])}; the scene's domain will contain them."
            for axis in np.flatnonzero(beyond)
        ]

    def _lengths(self) -> list[str]:
        stated = self.metadata.sequence_length
        if stated == UNSTATED or self.frames <= {stated, stated + 1}:
            return []
        few, many = min(self.frames), max(self.frames)
        held = f"{few}" if few == many else f"{few} to {many}"
        return [f"The metadata state sequence_length {stated}; trajectories have {held} frames."]
