"""Frames as rows of text: a column for each number of a particle."""

from __future__ import annotations

import re

import numpy as np

from nmpm.data.write.frames import Frame

_AXES = "xyz"
_PATTERNS = {"f": "%.9g", "U": "%s"}


def columns(frame: Frame, dim: int = 3) -> dict[str, np.ndarray]:
    """(n,) numbers by name: `x, y, z` of positions, `vx, vy, vz` of velocities, `name_x, …` of other vectors."""
    arrays = {"": frame.position, **frame.fields}
    named: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        if values.ndim == 1:
            named[re.sub(r"\W", "_", name)] = values
            continue
        prefix = {"": "", "velocity": "v"}.get(name, re.sub(r"\W", "_", name) + "_")
        named |= {prefix + axis: values[:, number] for number, axis in enumerate(_AXES[:dim])}
    return named


def rows(numbers: list[np.ndarray], separator: str) -> str:
    """A line for each of n particles, of (n,) arrays of numbers or texts; float32 are read back exactly."""
    pattern = separator.join(_PATTERNS.get(array.dtype.kind, "%d") for array in numbers) + "\n"
    return "".join(map(pattern.__mod__, zip(*(array.tolist() for array in numbers), strict=True)))
