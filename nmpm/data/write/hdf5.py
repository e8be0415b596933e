"""Native HDF5, which ParaView reads too."""

from __future__ import annotations

from collections.abc import Callable
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
        volume = particle_spacing(trajectory, metadata) ** metadata.dim
        described = replace(trajectory, attributes=description(trajectory, metadata, volume) | trajectory.attributes)
        write_viewable(path, [described])
        for _ in trajectory.position:
            step()
        return path

    def hint(self, path: Path) -> str:
        return f"nmpm view {path}, or ParaView"


class VtkHdf(NativeHdf5):
    """The same, by the suffix that ParaView knows, with velocities."""

    readers: ClassVar[str] = "ParaView, nmpm view"

    def write(
        self, path: Path, trajectory: Trajectory, metadata: Metadata, step: Callable[[], object] = no_step
    ) -> Path:
        velocity = np.stack(list(frame_velocities(trajectory, metadata)))
        with_velocity = replace(trajectory, fields={"velocity": velocity, **trajectory.fields})
        return super().write(path, with_velocity, metadata, step)
