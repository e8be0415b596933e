"""Particle-graph networks as choices: baselines beside the emulators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from nmpm._support.digests import short_digest, weights_digest
from nmpm.errors import ConfigError
from nmpm.evaluation.gns import TrainedGraph
from nmpm.evaluation.trade.choice import Choice, Kind, Rollout
from nmpm.evaluation.trade.scenes import Scenes


@dataclass(frozen=True, eq=False)
class GraphChoice(Choice):
    """A trained graph simulator, one scene at a time on the CPU.

    Args:
        name: Unique among the choices.
        graph: The simulator and its training.
        settings: What was chosen.
        threads: Threads of torch when it is timed.
    """

    name: str
    graph: TrainedGraph
    settings: Mapping[str, str | int | float]
    threads: int = 1
    kind: Kind = field(default=Kind.GRAPH, init=False)
    batch: int = field(default=1, init=False)

    @property
    def identity(self) -> Mapping[str, Any]:
        simulator = self.graph.simulator
        return {"gns": simulator.recipe.to_dict(), "weights": weights_digest(simulator.state_dict())}

    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Rollout:
        state = scenes.window(indices, 0).initial
        return lambda frames: self.graph.simulator.rollout(state, frames)


def graph_choices(graphs: Mapping[str, TrainedGraph], scenes: Scenes) -> list[Choice]:
    """One choice for each simulator, named by its training; by its folder too where those repeat.

    Raises:
        ConfigError: if one was trained for other scenes.
    """
    labels = [graph.label for graph in graphs.values()]
    choices: list[Choice] = []
    for name, graph in graphs.items():
        differing = graph.simulator.recipe.scene.differences(scenes.scene)
        if differing:
            raise ConfigError(
                f"The graph simulator {name} was trained for other scenes than those of {scenes.name}:"
                f" {', '.join(differing)} differ."
            )
        settings: dict[str, str | int | float] = {
            "model": "GNS",
            "weights": short_digest(graph.simulator.state_dict()),
            "precision": "float32",
            "runtime": "eager",
            "training_minutes": graph.minutes,
        }
        label = graph.label if labels.count(graph.label) == 1 else f"{graph.label} ({name})"
        choices.append(GraphChoice(label, graph, settings))
    return choices
