"""The request for a simulated dataset: its preset, the numbers of trajectories and the seed of each; shards of it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from nmpm.data.format import SPLITS
from nmpm.data.simulation import seed_of_draw
from nmpm.errors import ConfigError, DataError
from nmpm.sim import Preset

T = TypeVar("T")


@dataclass(frozen=True)
class SimulationRequest:
    """Everything that determines a simulated dataset.

    Args:
        preset: The family of scenes.
        counts: Trajectories in each of the splits train, valid and test; no file is written for 0.
        seed: The seeds of all trajectories are derived from it.
        redrawn: By split and index, the trajectories whose first seeds were unstable, and how many were. Known once
            they are simulated.

    Raises:
        ConfigError: if a split is unknown or missing, all are empty, or a number is negative.
    """

    preset: Preset
    counts: Mapping[str, int]
    seed: int = 0
    redrawn: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not _is_valid_counts(self.counts) or not self.splits or self.seed < 0:
            raise ConfigError(
                f"counts = {self.counts}, seed = {self.seed}: give the number of trajectories in each of "
                f"{', '.join(SPLITS)}, as in {{train: 3, valid: 1, test: 1}}, at least 1 in all; neither they nor the "
                "seed may be negative."
            )

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits that have trajectories."""
        return tuple(split for split in SPLITS if self.counts[split])

    @property
    def trajectories(self) -> list[tuple[str, int]]:
        """Split and index of every trajectory."""
        return [(split, index) for split in self.splits for index in range(self.counts[split])]

    def to_dict(self) -> dict[str, Any]:
        """The request as plain lists, strings and numbers, without what is known only once it is simulated."""
        counts = {split: self.counts[split] for split in SPLITS}
        return {"preset": self.preset.to_dict(), "counts": counts, "seed": self.seed, "revision": self.preset.revision}

    def entropy(self, split: str, index: int) -> tuple[int, int, int]:
        """The numbers that the seeds of a trajectory are derived from; independent of the counts."""
        return self.seed, SPLITS.index(split), index

    def trajectory_seed(self, split: str, index: int) -> int:
        """Seed of one trajectory."""
        return seed_of_draw(self.entropy(split, index), self.redrawn.get(split, {}).get(str(index), 0))

    def check_same(self, stored: object, folder: Path) -> None:
        """Raises a DataError if a folder's data were simulated by another request, as read from its JSON."""
        asked = json.loads(json.dumps(self.to_dict()))
        there = stored if isinstance(stored, dict) else {}
        if what := "; ".join(_differences("", there, asked)):
            raise DataError(
                f"{folder}: has other data than requested: {what}. Choose another folder, or delete this one."
            )


@dataclass(frozen=True)
class Shard:
    """Every `count`-th trajectory, from the `index`-th on, for the tasks of a cluster's job array.

    Args:
        index: Which shard, from 1 to `count`.
        count: Shards in all.

    Raises:
        ConfigError: if the index is not from 1 to `count`.
    """

    index: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.index <= self.count:
            raise ConfigError(f"shard {self}: shards are counted from 1, as in 1/8, 2/8, …, 8/8.")

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Reads "I/N"; raises a ConfigError if it cannot be read, or I is not from 1 to N."""
        match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if match is None:
            raise ConfigError(f"shard {text}: give I/N, as in 1/8, 2/8, …, 8/8.")
        return cls(int(match[1]), int(match[2]))

    def select(self, items: Sequence[T]) -> list[T]:
        """This shard's items; each item is in exactly one of the `count` shards."""
        return list(items[self.index - 1 :: self.count])


def same_trajectories(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two requests, as `SimulationRequest.to_dict` states them, give the same trajectories, if not as many."""
    return all(one.get(key) == other.get(key) for key in ("preset", "seed", "revision"))


def same_test_scenes(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two requests, as `SimulationRequest.to_dict` states them, give the same test trajectories."""
    counts = [request.get("counts") for request in (one, other)]
    first, second = (count.get("test") if isinstance(count, Mapping) else None for count in counts)
    return first == second and same_trajectories(one, other)


def _is_valid_counts(counts: object) -> bool:
    """Whether these are valid numbers of trajectories for all splits."""
    if not isinstance(counts, Mapping) or set(counts) != set(SPLITS):
        return False
    return all(isinstance(number, int) and number >= 0 for number in counts.values())


def _differences(path: str, stored: Mapping[str, Any], asked: Mapping[str, Any]) -> Iterator[str]:
    for key, value in asked.items():
        other = stored.get(key)
        if isinstance(value, dict) and isinstance(other, dict):
            yield from _differences(f"{path}{key}.", other, value)
        elif value != other:
            yield f"{path}{key} is {other}, requested {value}"
