"""NumPy's archives."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.atomic import atomic_write
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.write.base import TrajectoryWriter, no_step
from nmpm.data.write.frames import frame_times


class Npz(TrajectoryWriter):
    """`position` (T, N, D), `particle_type` (N,), `time` (T,), fields, and facts of the scene; `type_names` by id."""

    readers: ClassVar[str] = "NumPy"
    holds_all_fields: ClassVar[bool] = True

    def write(
        self, path: Path, trajectory: Trajectory, metadata: Metadata, step: Callable[[], object] = no_step
    ) -> Path:
        facts: dict[str, Any] = {
            "dt": metadata.dt,
            "bounds": metadata.bounds,
            "boundary": metadata.boundary,
            "gravity": trajectory.attributes.get("gravity", metadata.gravity),
            "particle_volume": metadata.particle_volume,
            "static_types": sorted(metadata.static_types),
            "type_names": [metadata.particle_types.get(i, "") for i in range(1 + max(metadata.particle_types))],
        }
        arrays = {
            **{name: np.array(value) for name, value in facts.items() if value is not None},
            **trajectory.fields,
            "time": frame_times(trajectory, metadata),
            "position": trajectory.position,
            "particle_type": trajectory.particle_type,
        }
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        for _ in trajectory.position:
            step()
        return path
