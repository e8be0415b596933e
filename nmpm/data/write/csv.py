"""CSV: a row for each particle in each frame."""

from __future__ import annotations

import re
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
    """Columns `frame, time, id, type, x, y[, z], vx, …`, one for each field, and the type's name as `material`."""

    holds_text_ids: ClassVar[bool] = True
    readers: ClassVar[str] = "spreadsheets, pandas, R"

    def write(
        self, path: Path, trajectory: Trajectory, metadata: Metadata, step: Callable[[], object] = no_step
    ) -> Path:
        with atomic_write(path) as part, part.open("w", encoding="utf-8") as file:
            for number, frame in enumerate(frames(trajectory, metadata)):
                count, named = len(frame.index), columns(frame, metadata.dim)
                if number == 0:
                    file.write(",".join(("frame", "time", "id", "type", *named, "material")) + "\n")
                head = [np.full(count, number), np.full(count, frame.time), _quoted(frame.label), frame.particle_type]
                material = _quoted(np.array([metadata.particle_types.get(i, "") for i in frame.particle_type.tolist()]))
                file.write(rows([*head, *named.values(), material], ","))
                step()
        return path


def _quoted(cells: np.ndarray) -> np.ndarray:
    """Cells, texts with a comma or quotation mark in quotation marks."""
    if cells.dtype.kind != "U":
        return cells
    special = np.array([re.search('[,"\\n]', text) is not None for text in cells.tolist()], bool)
    return np.where(special, np.char.add(np.char.add('"', np.char.replace(cells, '"', '""')), '"'), cells)
