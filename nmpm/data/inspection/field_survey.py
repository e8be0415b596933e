"""Summary of the fields that trajectories store, and of the input channels that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from nmpm.data.fields import FieldFacts, Kind, read_fields
from nmpm.data.format import Metadata, Split

_DIFFERS: Mapping[Kind, str] = MappingProxyType(
    {
        "evolving": "evolves",
        "property": "differs between particles",
        "parameter": "differs between trajectories",
        "constant": "is the same everywhere",
    }
)


class FieldSurvey:
    """Accumulates facts about fields; call `add` for each trajectory.

    Args:
        metadata: Of the dataset; declares fields.
    """

    def __init__(self, metadata: Metadata) -> None:
        self.metadata = metadata
        self.facts: dict[str, FieldFacts] = {}

    def add(self, split: Split, index: int, stored: Mapping[str, Sequence[int]]) -> None:
        """Adds a trajectory.

        Args:
            split: Its file.
            index: Its place there.
            stored: Shapes of the datasets beside positions, by name.

        Raises:
            DataError: if a declared field has no shape that a field can have.
        """
        sizes = (split.frames(index), split.particles(index))
        possible = [name for name, shape in stored.items() if tuple(shape) in (sizes, sizes[1:], (1,), ())]
        moving = np.isin(split.particle_type(index), self.metadata.moving_types)
        for name, values in read_fields(split, index, dict.fromkeys((*self.metadata.fields, *possible))).items():
            own = values if values.shape[1] == 1 else values[:, moving]
            self.facts.setdefault(name, FieldFacts(values.shape)).add(own)

    @property
    def varying(self) -> tuple[str, ...]:
        """Names of the fields that differ anywhere."""
        return tuple(name for name, facts in self.facts.items() if facts.kind != "constant")

    def channels(self, materials: Sequence[str]) -> dict[str, str]:
        """For each field a phrase: how it varies, and the input channels that it makes with these materials."""
        return {name: self._describe(name, facts, materials) for name, facts in self.facts.items()}

    def _describe(self, name: str, facts: FieldFacts, materials: Sequence[str]) -> str:
        kind = facts.kind
        what = f"{_DIFFERS[kind]}, {facts.low:.4g}…{facts.high:.4g}"
        if kind == "constant":
            return f"{_DIFFERS[kind]}, {facts.low:.4g}: no channel"
        if name not in self.metadata.fields:
            return f"{what}; not declared: no channel (--data.fields)"
        own = name if kind == "parameter" else ", ".join(f"{material}.{name}" for material in materials)
        return f"{what}: {own}{', predicted' if kind == 'evolving' else ''}"
