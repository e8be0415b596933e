"""Fields of a dataset: further numbers by name that each trajectory stores beside its positions.

A field is an HDF5 dataset of the trajectory's group, of shape (T, N), one number for each particle in each frame; or
(N,), one for each particle; or (), one for the trajectory, which may be an attribute instead. Inputs of models
are those that the metadata's `fields` or `data.fields` name and that differ anywhere in the dataset.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from nmpm.data.format import Metadata, Split
from nmpm.data.hdf5 import check_stored_size, open_hdf5
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

    def add(self, values: np.ndarray) -> None:
        """Adds a trajectory's values (T or 1, N or 1) of moving particles."""
        if values.size:
            self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))
            change = float(np.ptp(values, axis=0).max())
            self.evolves |= change > _SAME * float(np.abs(values).max())


def add_fields(
    facts: dict[str, FieldFacts], split: Split, index: int, metadata: Metadata, names: Iterable[str]
) -> None:
    """Adds a trajectory's fields to the facts about the dataset's; names that it lacks are left out."""
    moving = metadata.is_moving(split.particle_type(index))
    for name, values in read_fields(split, index, names).items():
        facts.setdefault(name, FieldFacts(values.shape)).add(values if values.shape[1] == 1 else values[:, moving])


def read_fields(split: Split, index: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """The named fields that a trajectory has, (T, N), (1, N) or (1, 1) float32; a DataError for another shape."""
    fields: dict[str, np.ndarray] = {}
    where, sizes = split.where(index), (split.frames(index), split.particles(index))
    with open_hdf5(split.path) as file:
        group = file[split.names[index]]
        for name in names:
            values = group.get(name)
            if values is not None and hasattr(values, "dtype"):
                check_stored_size(values, f"{where}: {name}")
                fields[name] = _arrange(split.cut(index, values[()]), sizes, f"{where}: {name}")
            elif name in group.attrs:
                fields[name] = _arrange(group.attrs[name], sizes, f"{where}: {name}")
    return fields


def _arrange(values: Any, sizes: tuple[int, int], where: str) -> np.ndarray:
    """Values as (T, N), (1, N) or (1, 1)."""
    array = np.asarray(values)
    if array.dtype.kind in "biuf":
        if array.size == 1 and array.ndim <= 1:
            return array.reshape(1, 1).astype(np.float32)
        if array.shape == sizes:
            return array.astype(np.float32)
        if array.shape == sizes[1:]:
            return array[None].astype(np.float32)
    raise DataError(
        f"{where} is {array.dtype} of shape {array.shape}; a field is (T, N) = {sizes} numbers, ({sizes[1]},) or one."
        " Store each component of a vector as a field of its own."
    )


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


def check_finite(name: str, values: np.ndarray, moving: np.ndarray, where: str) -> None:
    """Raises a DataError if a field (T, N') of the moving particles, (N,) of which N' are, is not finite."""
    wrong = ~np.isfinite(values)
    if wrong.any():
        frame, index = map(int, np.argwhere(wrong)[0])
        particle = int(np.flatnonzero(moving)[index])
        raise DataError(
            f"{where}: {name} of particle {particle} in frame {frame} is {values[frame, index]}; fields of moving"
            " particles must be finite. Remove the trajectory, or leave the field out of data.fields."
        )
