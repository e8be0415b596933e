"""Native HDF5, which ParaView reads too."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm.data.described import description
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.write.base import TrajectoryWriter, no_step
from nmpm.data.write.frames import frame_velocities, particle_spacing
from nmpm.data.write.vtkhdf import write_viewable


class NativeHdf5(TrajectoryWriter):
    """The native layout: a file that all of nmpm reads, and ParaView."""

    readers: ClassVar[str] = "nmpm view, ParaView"
    holds_all_fields: ClassVar[bool] = True

    def write(
        self, path: Path, trajectory: Trajectory, metadata: Metadata, step: Callable[[], object] = no_step
    ) -> Path:
        return self.write_all(path, [trajectory], metadata, step)[0]

    def write_all(
        self, path: Path, trajectories: Iterable[Trajectory], metadata: Metadata, step: Callable[[], object] = no_step
    ) -> list[Path]:
        write_viewable(path, self._described(trajectories, metadata, step))
        return [path]

    def paths(self, path: Path, count: int) -> list[Path]:  # noqa: ARG002
        return [path]

    def _described(
        self, trajectories: Iterable[Trajectory], metadata: Metadata, step: Callable[[], object]
    ) -> Iterator[Trajectory]:
        """The trajectories with attributes that describe their scene; steps once each is written."""
        for trajectory in trajectories:
            volume = particle_spacing(trajectory, metadata) ** metadata.dim
            attributes = description(trajectory, metadata, volume) | trajectory.attributes
            yield replace(trajectory, attributes=attributes)
            for _ in trajectory.position:
                step()

    def hint(self, path: Path) -> str:
        return f"nmpm view {shlex.quote(str(path))}, or ParaView"


class VtkHdf(NativeHdf5):
    """The same, by the suffix that ParaView knows, with velocities."""

    readers: ClassVar[str] = "ParaView, nmpm view"

    def write_all(
        self, path: Path, trajectories: Iterable[Trajectory], metadata: Metadata, step: Callable[[], object] = no_step
    ) -> list[Path]:
        return super().write_all(path, (_with_velocity(one, metadata) for one in trajectories), metadata, step)


def _with_velocity(trajectory: Trajectory, metadata: Metadata) -> Trajectory:
    velocity = np.stack(list(frame_velocities(trajectory, metadata)))
    return replace(trajectory, fields={"velocity": velocity, **trajectory.fields})
