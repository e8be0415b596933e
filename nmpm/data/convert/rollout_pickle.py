"""The rollouts that DeepMind's code and its PyTorch successors pickle."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.bounded_files import read_bounded
from nmpm.data.convert.base import FileFormat, Options
from nmpm.data.convert.restricted_pickle import load_pickled, number_array
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.metadata_json import parse_metadata
from nmpm.errors import DataError

_BYTES = 2**31
_NEEDED = ("initial_positions", "ground_truth_rollout", "particle_types", "metadata")


class RolloutPickle(FileFormat):
    """A `rollout_*.pkl` of DeepMind's code or its PyTorch successors, or a folder of them."""

    name: ClassVar[str] = "rollout-pickle"
    summary: ClassVar[str] = "rollouts as DeepMind's code pickles them (ground_truth_rollout, …)"
    pattern: ClassVar[str] = "*.pkl"

    def metadata(self, file: Path, options: Options) -> tuple[Metadata, tuple[str, ...]]:
        stated = _content(file)["metadata"]
        if not isinstance(stated, dict):
            raise DataError(f"{file}: metadata must map keys to values; it is {type(stated).__name__}.")
        numpy = np.ndarray | np.generic
        plain = {key: value.tolist() if isinstance(value, numpy) else value for key, value in stated.items()}
        note = (
            "The true trajectories become the positions; the predictions are kept as the field predicted_rollout, with"
            " the initial positions in front."
        )
        return parse_metadata(plain, file, options.family or self.family), (note,)

    def read(self, file: Path, metadata: Metadata, options: Options) -> Iterator[Trajectory]:  # noqa: ARG002
        content = _content(file)
        arrays: dict[str, np.ndarray] = {
            key: number_array(content[key], f"{file}: {key}")
            for key in ("initial_positions", "ground_truth_rollout", "predicted_rollout", "particle_types")
            if key in content
        }
        try:
            initial, types = arrays.pop("initial_positions"), arrays.pop("particle_types")
            fields = {key: np.concatenate([initial, part]).astype(np.float32) for key, part in arrays.items()}
            yield Trajectory(fields.pop("ground_truth_rollout"), types, {}, fields)
        except (ValueError, TypeError, MemoryError) as error:
            raise DataError(f"{file}: {error}") from error


def _content(path: Path) -> dict[str, Any]:
    content = load_pickled(read_bounded(path, _BYTES), str(path))
    if not isinstance(content, dict) or not all(key in content for key in _NEEDED):
        raise DataError(f"{path}: a rollout is a dict of {', '.join(_NEEDED)}; this is something else.")
    return content
