"""Fields of a dataset: further numbers by name that each trajectory stores beside its positions.

A field is an HDF5 dataset of the trajectory's group, of shape (T, N), one number for each particle in each frame; or
(N,), one for each particle; or (), one for the trajectory, which may be an attribute instead. Inputs of models
are those that the metadata's `fields` or `data.fields` name and that differ anywhere in the dataset.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from nmpm.data.format import Metadata, Split
from nmpm.data.hdf5 import open_hdf5
from nmpm.errors import DataError

Kind = Literal["evolving", "property", "parameter", "constant"]

_SAME = 1e-6
"""Values that differ by less than this part of the largest one are the same."""


@dataclass
class FieldFacts:
    """Values of a field in the trajectories seen so far, of moving particles."""

    shape: tuple[int, ...]  # in the first one
    low: float = np.inf
    high: float = -np.inf
    evolves: bool = False  # whether a value changes in time

    @property
    def kind(self) -> Kind:
        """Evolving, or a property of particles or a parameter of trajectories that is constant in time, or constant."""
        if not self.high - self.low > _SAME * max(abs(self.low), abs(self.high)):
            return "constant"
        if self.evolves:
            return "evolving"
        return "parameter" if self.shape == (1, 1) else "property"


class FieldSurvey(dict[str, FieldFacts]):
    """What is known of a dataset's fields, by name, in the trajectories added so far."""

    def __init__(self, metadata: Metadata) -> None:
        super().__init__()
        self._metadata = metadata

    def add(self, split: Split, index: int, names: Iterable[str]) -> None:
        """Adds the named fields of a trajectory; those that it lacks are left out."""
        for name, values in read_fields(split, index, names).items():
            facts = self.setdefault(name, FieldFacts(values.shape))
            if values.shape[1] > 1:
                values = values[:, self._metadata.is_moving(split.particle_type(index))]
            if values.size:
                facts.low, facts.high = min(facts.low, float(values.min())), max(facts.high, float(values.max()))
                facts.evolves |= float(np.ptp(values, axis=0).max()) > _SAME * float(np.abs(values).max())

    def names(self, kind: Kind) -> tuple[str, ...]:
        """Names of the fields of a kind."""
        return tuple(name for name, facts in self.items() if facts.kind == kind)


def read_fields(split: Split, index: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """The named fields that a trajectory has, (T, N), (1, N) or (1, 1) float32; a DataError for another shape."""
    names = list(names)
    attributes = split.attributes(index) if names else {}
    known = attributes | split.stored(index, names)
    stored = {name: known[name] for name in names if name in known}
    fields, sizes = dict[str, np.ndarray](), (split.frames(index), split.particles(index))
    for name, values in stored.items():
        array = np.asarray(values)
        shape = {sizes: sizes, sizes[1:]: (1, *sizes[1:])}.get(array.shape)
        if array.size == 1 and array.ndim <= 1:
            shape = (1, 1)
        if shape is None or array.dtype.kind not in "biuf":
            raise DataError(
                f"{split.where(index)}: {name} is {array.dtype} of shape {array.shape}; a field is (T, N) = {sizes}"
                f" numbers, ({sizes[1]},) or one. Store each component of a vector as a field of its own."
            )
        fields[name] = array.reshape(shape).astype(np.float32)
    return fields


def require_fields(split: Split, names: Sequence[str]) -> None:
    """Raises a DataError that names the first trajectory that lacks one of the declared fields."""
    if not names:
        return
    with open_hdf5(split.path) as file:
        for index, group_name in enumerate(split.names):
            group = file[group_name]
            stored = sorted({*group, *group.attrs} - {"position", "particle_type"})
            missing = [name for name in names if name not in stored]
            if missing:
                raise DataError(
                    f"{split.where(index)}: it has no field {', '.join(missing)}, which the metadata's `fields` or"
                    f" data.fields name (it has: {', '.join(stored) or 'none'}). Correct the name, or leave it out."
                )
