"""Trained graph simulators as folders: `gns.json` and `model.safetensors`; the state of a training as one file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import read_bounded
from nmpm.errors import ConfigError, DataError
from nmpm.evaluation.gns.simulator import GraphRecipe, GraphSimulator

_FACTS, _WEIGHTS = "gns.json", "model.safetensors"
_MOST_FACTS, _MOST_WEIGHTS = 2**20, 2**30  # bytes
STEADY = 0.02
"""A training has converged if its validation loss fell by less than this share over the last half of its time."""


@dataclass(frozen=True)
class TrainedGraph:
    """A graph simulator and how it was trained.

    Args:
        simulator: In evaluation mode.
        minutes: CPU time of its training.
        steps: Of its training.
        curve: (minutes, validation loss) in the order of time; the last is the simulator's own.
    """

    simulator: GraphSimulator
    minutes: float
    steps: int
    curve: tuple[tuple[float, float], ...]

    @property
    def converged(self) -> bool:
        """Whether more training would not have changed much, see `STEADY`; False where that is not known."""
        halfway = [loss for minutes, loss in self.curve if minutes <= self.minutes / 2]
        return bool(halfway) and self.curve[-1][1] >= (1 - STEADY) * halfway[-1]

    @property
    def label(self) -> str:
        """Its name in charts; "not converged" is part of it where that is so."""
        return f"GNS, {self.minutes:.3g} min of training" + ("" if self.converged else ", not converged")


def is_graph_folder(folder: Path) -> bool:
    """Whether a folder holds a graph simulator."""
    return (Path(folder) / _FACTS).is_file()


def write_graph(folder: Path, graph: TrainedGraph) -> None:
    """Write a graph simulator; its facts last, so that a folder with them is complete."""
    facts = {
        "format": 1,
        "recipe": graph.simulator.recipe.to_dict(),
        "minutes": graph.minutes,
        "steps": graph.steps,
        "curve": [list(point) for point in graph.curve],
    }
    weights = {name: values.detach().cpu().contiguous() for name, values in graph.simulator.state_dict().items()}
    with atomic_write(folder / _WEIGHTS) as part:
        part.write_bytes(save(weights))
    with atomic_write(folder / _FACTS) as part:
        part.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def read_graph(folder: Path) -> TrainedGraph:
    """The graph simulator of a folder.

    Raises:
        DataError: naming the file that cannot be read, or does not fit the other.
    """
    path = Path(folder) / _FACTS
    try:
        facts: Mapping[str, Any] = json.loads(read_bounded(path, _MOST_FACTS))
        simulator = GraphRecipe.from_dict(facts["recipe"]).build().eval()
        curve = tuple((float(minutes), float(loss)) for minutes, loss in facts["curve"])
        graph = TrainedGraph(simulator, float(facts["minutes"]), int(facts["steps"]), curve)
    except (ValueError, KeyError, TypeError, ConfigError) as error:
        raise DataError(f"{path} describes no graph simulator: {error}") from error
    _load_weights(simulator, Path(folder) / _WEIGHTS)
    return graph


def write_progress(path: Path, state: Mapping[str, Tensor], curve: Sequence[tuple[float, float]]) -> None:
    """Write the state of a training, see `GraphTrainer.state_dict`, and its validation losses by minutes."""
    tensors = {name: values.contiguous() for name, values in state.items()}
    with atomic_write(path) as part:
        part.write_bytes(save(tensors, {"curve": json.dumps([list(point) for point in curve])}))


def read_progress(path: Path) -> tuple[dict[str, Tensor], list[tuple[float, float]]]:
    """What `write_progress` wrote.

    Raises:
        DataError: naming the file, if it cannot be read.
    """
    try:
        with safe_open(path, "pt") as file:
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
            facts = file.metadata() or {}
        return state, [(float(minutes), float(loss)) for minutes, loss in json.loads(facts["curve"])]
    except (OSError, SafetensorError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is no state of a training: {error}. Delete it to start over.") from error


def _load_weights(simulator: GraphSimulator, path: Path) -> None:
    try:
        weights = load(read_bounded(path, _MOST_WEIGHTS))
        simulator.load_state_dict(weights)
    except (SafetensorError, RuntimeError) as error:
        raise DataError(f"{path} does not fit the simulator that gns.json beside it describes: {error}") from error
    unsound = [name for name, values in weights.items() if not bool(values.isfinite().all())]
    if unsound:
        raise DataError(f"{path}: {unsound[0]} holds values that are not finite.")
