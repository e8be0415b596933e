"""Published families of datasets: what their particle type ids mean. Without NumPy, as commands need the names."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from nmpm.errors import ConfigError

PADDING = "padding"
STATIC_NAMES = frozenset({"boundary", "wall", "obstacle"})


@dataclass(frozen=True)
class Family:
    """Names of the particle type ids in one family of datasets, and the ids that do not move or move as recorded.

    The same id means different things in different families, so a dataset either names its types in its metadata or
    states which family it follows.
    """

    types: Mapping[int, str]
    static: frozenset[int]
    prescribed: frozenset[int] = frozenset()


FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        "deepmind": Family(
            MappingProxyType({0: "rigid", 3: "boundary", 5: "water", 6: "sand", 7: "goop"}), frozenset({3})
        ),
        "lagrangebench": Family(
            MappingProxyType({-1: PADDING, 0: "fluid", 1: "wall", 2: "moving wall", 3: "rigid"}),
            frozenset({1}),
            frozenset({2}),
        ),
        "jax-sph": Family(
            MappingProxyType({-1: PADDING, 0: "fluid", 1: "wall", 2: "moving wall", 3: "heated wall"}),
            frozenset({1, 3}),
            frozenset({2}),
        ),
    }
)
"""DeepMind: Sanchez-Gonzalez et al., ICML 2020. LagrangeBench: Toshev et al., NeurIPS 2023. JAX-SPH: Toshev et al.,
2024; its heated walls have the id of LagrangeBench's rigid bodies."""


def find_family(name: str) -> Family:
    """The family with a name; raises a ConfigError that lists the known ones if there is no such family."""
    if name not in FAMILIES:
        raise ConfigError(f"No family of particle types is called {name!r}; known: {', '.join(sorted(FAMILIES))}.")
    return FAMILIES[name]


def unambiguous_family(ids: Collection[int]) -> str | None:
    """The family that type ids are of; None where several give them different meanings, or none any.

    DeepMind's have materials that the others lack; fluids and walls without further types mean the same in the others.
    """
    if {*ids} <= {*FAMILIES["deepmind"].types} and {*ids} & {5, 6, 7}:
        return "deepmind"
    return "lagrangebench" if {*ids} <= {-1, 0, 1, 2} else None


def guess_family(ids: Collection[int], plain: Mapping[str, Any]) -> str:
    """The family that type ids are of, or else that knows most; of equal ones LagrangeBench's where its keys occur."""
    names = ["deepmind", "lagrangebench", "jax-sph"]
    if "periodic_boundary_conditions" in plain:
        names = names[1:] + names[:1]
    return unambiguous_family(ids) or min(names, key=lambda name: len(set(ids) - set(FAMILIES[name].types)))
