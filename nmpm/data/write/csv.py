"""CSV: a row for each particle in each frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm._support.atomic import atomic_write
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.write.base import TrajectoryWriter, no_step
from nmpm.data.write.frames import frames
from nmpm.data.write.text import columns, rows


class Csv(TrajectoryWriter):
    """Columns `frame, time, id, type, x, y[, z], vx, …`, and one for each field."""

    readers: ClassVar[str] = "spreadsheets, pandas, R"

    def write(
        self, path: Path, trajectory: Trajectory, metadata: Metadata, step: Callable[[], object] = no_step
    ) -> Path:
        with atomic_write(path) as part, part.open("w", encoding="utf-8") as file:
            for number, frame in enumerate(frames(trajectory, metadata)):
                count, named = len(frame.index), columns(frame, metadata.dim)
                if number == 0:
                    file.write(",".join(("frame", "time", "id", "type", *named)) + "\n")
                head = (np.full(count, number), np.full(count, frame.time), frame.index, frame.particle_type)
                file.write(rows([*head, *named.values()], ","))
                step()
        return path
