"""Trajectories of an embedded dataset, or straight from a simulator. Apart, as the simulators take time to import."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from nmpm.data import catalog
from nmpm.data.format import SPLITS
from nmpm.data.loading.buffer import RecordingProvider
from nmpm.data.loading.simulated import SimulatedRecordings
from nmpm.data.loading.sources import DataSource
from nmpm.data.loading.window_plan import EndlessWindowPlan, WindowPlan
from nmpm.errors import ConfigError
from nmpm.scene import Scene

_GENERATE = frozenset(inspect.signature(catalog.ensure).parameters) - {"name"}


@dataclass(frozen=True)
class EmbeddedSource(DataSource):
    """An embedded dataset, simulated on first use.

    Args:
        name: One of `nmpm.data.catalog.catalog()`.
        generate: Keyword arguments of `nmpm.data.catalog.ensure`.
    """

    name: str
    generate: dict[str, Any] = field(default_factory=dict)

    @property
    def description(self) -> str:
        return f"{self.name}, simulated by nmpm"

    @cached_property
    def folder(self) -> Path:
        return catalog.ensure(self.name, **self._check_options())

    @property
    def scene(self) -> Scene:
        return catalog.scene(self.name)

    def _check_options(self) -> dict[str, Any]:
        unknown = sorted(set(self.generate) - _GENERATE)
        if unknown:
            mend = (
                " Trajectories per split belong under counts: generate: {counts: {train: 4, valid: 1, test: 1}}."
                if set(unknown) & set(SPLITS)
                else ""
            )
            raise ConfigError(
                f"generate = {self.generate}: {', '.join(map(repr, unknown))} is not an option; there are"
                f" {', '.join(sorted(_GENERATE))}.{mend}"
            )
        return self.generate


@dataclass(frozen=True)
class SimulatedSource(EmbeddedSource):
    """Trains on new trajectories from the simulator, each in one buffer only; evaluates on the embedded dataset."""

    @property
    def description(self) -> str:
        return f"{self.name}, simulated by nmpm while training"

    @cached_property
    def folder(self) -> Path:
        options = self._check_options()
        counts = dict(options.get("counts") or catalog.describe(self.name).counts)
        return catalog.ensure(self.name, **(options | {"counts": counts | {"train": 0}}))

    @cached_property
    def training_recordings(self) -> SimulatedRecordings:
        """The trajectories to train on: one provider, whose buffers calibration and training share."""
        options = {key: value for key, value in self._check_options().items() if key not in ("counts", "workers")}
        request = catalog.simulation_request(self.name, **options)
        return SimulatedRecordings(request.preset, request.seed, self.generate.get("workers"))

    def training_data(self, length: int, **plan: Any) -> tuple[RecordingProvider, WindowPlan]:
        frames = (self.training_recordings.preset.frames + 1,) * plan["buffer_size"]
        return self.training_recordings, EndlessWindowPlan(frames=frames, length=length, **plan)
