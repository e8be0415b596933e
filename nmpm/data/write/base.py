"""The interface of writers: a writer is one subclass of `TrajectoryWriter` in one file, listed in `WRITERS`."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from nmpm._support.atomic import file_obstacle

if TYPE_CHECKING:
    from nmpm.data.format import Metadata, Trajectory


def no_step() -> None:
    """Counts no frames."""


class TrajectoryWriter(abc.ABC):
    """Abstract writer of one trajectory into a file that other programs read, one subclass per form.

    Attributes:
        readers: Programs that open the file, in words.
        holds_all_fields: Also those that are not of particles.
        holds_text_ids: Ids that are texts; others number the particles.
    """

    readers: ClassVar[str]
    holds_all_fields: ClassVar[bool] = False
    holds_text_ids: ClassVar[bool] = False

    @abc.abstractmethod
    def write(
        self, path: Path, trajectory: Trajectory, metadata: Metadata, step: Callable[[], object] = no_step
    ) -> Path:
        """Writes a trajectory, whole or not at all, in place of a former file; `step` is called after each frame.

        Returns:
            The file that other programs are to open.

        Raises:
            DataError or OSError: if it cannot be written.
        """

    def write_all(
        self, path: Path, trajectories: Iterable[Trajectory], metadata: Metadata, step: Callable[[], object] = no_step
    ) -> list[Path]:
        """As `write`, several trajectories into `paths`, each taken when the one before is written."""
        return [
            self.write(self.paths(path, number + 1)[-1], trajectory, metadata, step)
            for number, trajectory in enumerate(trajectories)
        ]

    def paths(self, path: Path, count: int) -> list[Path]:
        """The files of so many trajectories: a file for each, out-0.csv, out-1.csv, …, unless one holds them all."""
        return [path.with_stem(f"{path.stem}-{number}") for number in range(count)]

    def obstacle(self, path: Path) -> str:
        """Why nothing can be written to a path, in words; empty if it can."""
        return file_obstacle(path)

    def hint(self, path: Path) -> str:
        """How to look at a written file."""
        return f"open {path} in {self.readers}"
