"""The rollouts that DeepMind's code and its PyTorch successors pickle."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.bounded_files import read_bounded
from nmpm._support.limits import PICKLE_BYTES
from nmpm.data.convert.base import DatasetFormat, ForeignDataset, Options, Rereadable
from nmpm.data.convert.restricted_pickle import load_pickled, number_array
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.metadata import metadata_from_dict
from nmpm.errors import DataError


class RolloutPickle(DatasetFormat):
    """A `rollout_*.pkl` of DeepMind's code or its PyTorch successors, or a folder of them."""

    name: ClassVar[str] = "rollout-pickle"
    summary: ClassVar[str] = "rollouts as DeepMind's code pickles them (ground_truth_rollout, …)"

    def recognises(self, path: Path) -> bool:
        return bool(_files(path))

    def open(self, path: Path, options: Options) -> ForeignDataset:
        files = _files(path)
        if not files:
            raise DataError(f"{path}: no .pkl file there.")
        family = options.family or "deepmind"
        return ForeignDataset(
            metadata=options.apply_to(_metadata(files[0], family)),
            splits={"test": Rereadable(partial(_trajectories, files))},
            notes=(
                f"Particle types have the meaning of the {family} family.",
                "The true trajectories become the positions; the predictions are kept as the field"
                " predicted_rollout, with the initial positions in front.",
            ),
            counts={"test": len(files)},
        )


def _files(path: Path) -> tuple[Path, ...]:
    if path.is_dir():
        return tuple(sorted(path.glob("*.pkl")))
    return (path,) if path.suffix == ".pkl" and path.is_file() else ()


def _content(path: Path) -> dict[str, Any]:
    content = load_pickled(read_bounded(path, PICKLE_BYTES), str(path))
    needed = ("initial_positions", "ground_truth_rollout", "particle_types", "metadata")
    if not isinstance(content, dict) or not all(key in content for key in needed):
        found = ", ".join(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise DataError(f"{path}: a rollout has {', '.join(needed)}; found {found[:200]}.")
    return content


def _metadata(path: Path, family: str) -> Metadata:
    plain = _content(path)["metadata"]
    if not isinstance(plain, dict):
        raise DataError(f"{path}: metadata must map keys to values; it is {type(plain).__name__}.")
    return metadata_from_dict(_to_plain(plain), path, family)


def _to_plain(value: Any) -> Any:
    """Converts NumPy's arrays and numbers to Python's lists and numbers."""
    if isinstance(value, dict):
        return {str(key): _to_plain(item) for key, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _trajectories(files: tuple[Path, ...]) -> Iterator[Trajectory]:
    for path in files:
        content = _content(path)
        initial = number_array(content["initial_positions"], f"{path}: initial_positions").astype(np.float32)
        parts = {
            key: number_array(content[key], f"{path}: {key}").astype(np.float32)
            for key in ("ground_truth_rollout", "predicted_rollout")
            if key in content
        }
        try:
            whole: dict[str, np.ndarray] = {key: np.concatenate([initial, part]) for key, part in parts.items()}
            types = number_array(content["particle_types"], f"{path}: particle_types")
            yield Trajectory(whole.pop("ground_truth_rollout"), types, {}, whole)
        except (ValueError, TypeError, MemoryError) as error:
            raise DataError(f"{path}: {error}") from error
