"""A fact, how it was found and how sure it is; and all facts about a dataset."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, TypeVar

from nmpm.data.metadata import Metadata
from nmpm.scene import Boundary, Interval

Value = TypeVar("Value")
Sure = Literal["measured", "likely", "guessed"]

FOUND = "found"
"""Key of `metadata.json`: how each fact was found, a sentence by the fact's name."""


@dataclass(frozen=True)
class Fact(Generic[Value]):
    """A value with one sentence on how it was found."""

    value: Value
    how: str
    sure: Sure

    def __str__(self) -> str:
        return f"{self.sure}: {self.how}"


@dataclass(frozen=True)
class Unmoving:
    """Particles of a moving type that never move in a trajectory where others do."""

    trajectory: int
    particle: int  # the first of them
    count: int


@dataclass(frozen=True)
class Facts:
    """Facts about a dataset, named as the fields of `Metadata`; lengths and times in the file's units."""

    bounds: Fact[tuple[Interval, ...]]
    domain: Fact[tuple[Interval, ...]]  # what a grid should cover
    boundary: Fact[tuple[Boundary, ...]]
    dt: Fact[float]
    gravity: Fact[tuple[float, ...] | None]  # None where it is not known
    particle_types: Fact[dict[int, str]]
    static_types: Fact[frozenset[int]]
    prescribed_types: Fact[frozenset[int]]
    particle_volume: Fact[float | None]  # None where it is not known
    sequence_length: Fact[int]
    unmoving: tuple[Unmoving, ...] = ()  # particles of materials that never move where others do

    def complete(self, metadata: Metadata, unknown: Collection[str]) -> Metadata:
        """The metadata with the `unknown` fields replaced by these facts, and notes on them under the key `found`.

        Types that the metadata name or declare static remain so. With the static types, the prescribed ones are found;
        with the bounds, the domain.
        """
        names = {*unknown, *({"prescribed_types"} if "static_types" in unknown else ())}
        if "bounds" in unknown and metadata.domain is None:
            names.add("domain")
        unnamed = sorted(set(self.particle_types.value) - set(metadata.particle_types))
        if not unnamed:
            names.discard("particle_types")
        if metadata.prescribed_types and self.prescribed_types.value <= metadata.prescribed_types:
            names.discard("prescribed_types")
        facts: dict[str, Fact[Any]] = {name: fact for name, fact in vars(self).items() if name in names}
        if "particle_types" in facts and metadata.particle_types:
            how = f"those of type {', '.join(map(str, unnamed))} {self.particle_types.how}"
            facts["particle_types"] = replace(self.particle_types, how=how)
        values = {name: fact.value for name, fact in facts.items()}
        if "particle_types" in values:
            values["particle_types"] = values["particle_types"] | metadata.particle_types
        for name in {"static_types", "prescribed_types"} & set(values):
            values[name] |= getattr(metadata, name)
        notes = {name: str(fact) for name, fact in facts.items()}
        return replace(metadata, **values, extra=metadata.extra | {FOUND: notes})
