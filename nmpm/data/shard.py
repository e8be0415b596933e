"""One of several parts of a simulation, for the tasks of a cluster's job array."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from nmpm.errors import ConfigError

T = TypeVar("T")


@dataclass(frozen=True)
class Shard:
    """Every `count`-th item, from the `index`-th on.

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
        """Reads "I/N".

        Raises:
            ConfigError: if it cannot be read, or I is not from 1 to N.
        """
        found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if found is None:
            raise ConfigError(f"shard {text}: give I/N, as in 1/8, 2/8, …, 8/8.")
        return cls(int(found[1]), int(found[2]))

    def select(self, items: Sequence[T]) -> list[T]:
        """This shard's items; each item is in exactly one of the `count` shards."""
        return list(items[self.index - 1 :: self.count])
