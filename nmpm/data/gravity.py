"""Gravity of datasets and of single trajectories, in length/s².

The metadata may state one gravity, and trajectories their own as an attribute. Numbers are compared with a tolerance: a
float32 attribute beside the metadata's float64 is no other gravity.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nmpm._support.messages import one_line
from nmpm.data.format import METADATA_FILE, Metadata, Split
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Scene

Gravity = tuple[float, ...]


def trajectory_gravity(attributes: Mapping[str, Any], facts: Scene | Metadata, where: str) -> Gravity | None:
    """The gravity (D,) that a trajectory's attributes state, else its scene or dataset; None if neither does.

    Raises:
        DataError: naming `where`, if the attribute is not a finite number for each axis.
    """
    stated = attributes.get("gravity")
    if stated is None:
        return facts.gravity
    try:
        values = np.asarray(stated, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (facts.dim,) or not np.isfinite(values).all():
        raise DataError(
            f"{where}: the attribute gravity = {one_line(stated, 60)} should be {facts.dim} finite numbers."
        )
    return tuple(values.tolist())


def distinct_gravities(values: Iterable[Gravity | None]) -> tuple[Gravity, ...]:
    """The different ones among gravities, without None; one if all are the same."""
    distinct = tuple(dict.fromkeys(value for value in values if value is not None))
    return distinct[:1] if all(_same(distinct[0], other) for other in distinct) else distinct


def _same(one: Gravity, other: Gravity) -> bool:
    return len(one) == len(other) and np.allclose(one, other, atol=1e-6)


def check_gravity(given: Sequence[float], stated: Gravity | None, path: Path) -> None:
    """Raises a ConfigError if a user's gravity contradicts that of a file, which may state none."""
    values = tuple(map(float, given))
    if stated is not None and not _same(values, stated):
        raise ConfigError(
            f"gravity = {list(values)} contradicts {path}, which states gravity {list(stated)}. Leave the option"
            " out to use the file's; if the file is wrong, write a corrected copy with nmpm convert FOLDER NEW"
            f" --gravity={','.join(f'{value:g}' for value in values)}."
        )


def common_gravity(gravities: tuple[Gravity, ...], metadata: Metadata, split: Split) -> Gravity | None:
    """The metadata's gravity, or else that of all trajectories; None if neither is known.

    Raises:
        DataError: if all trajectories state one that is not the metadata's: models would learn theirs, and fall by the
            metadata's.
    """
    only = gravities[0] if len(gravities) == 1 else None
    if metadata.gravity and only is not None and not _same(metadata.gravity, only):
        raise DataError(
            f"{split.path}: all trajectories have the attribute gravity {list(only)}, but {METADATA_FILE} states"
            f" {list(metadata.gravity)}. If the trajectories are right, write a corrected copy with nmpm convert FOLDER"
            f" NEW --gravity={','.join(f'{value:g}' for value in only)}; otherwise remove their attribute."
        )
    return metadata.gravity or only
