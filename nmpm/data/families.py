"""Meaning of the particle type ids in the published families of datasets.

The same id means different things in different families, so a dataset either names its types in its metadata or states
which family it follows. DeepMind: Sanchez-Gonzalez et al., ICML 2020. LagrangeBench: Toshev et al., NeurIPS 2023.
JAX-SPH: Toshev et al., 2024; its heated walls have the id of LagrangeBench's rigid bodies.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from nmpm.errors import ConfigError

PADDING = "padding"
STATIC_NAMES = frozenset({"boundary", "wall", "obstacle"})


@dataclass(frozen=True)
class Family:
    """The particle types of one family of datasets.

    Args:
        types: Name of each particle type id.
        static: Ids of the types that do not move.
    """

    types: Mapping[int, str]
    static: frozenset[int]


FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        "deepmind": Family(
            MappingProxyType({0: "rigid", 3: "boundary", 5: "water", 6: "sand", 7: "goop"}), frozenset({3})
        ),
        "lagrangebench": Family(
            MappingProxyType({-1: PADDING, 0: "fluid", 1: "wall", 2: "moving wall", 3: "rigid"}), frozenset({1})
        ),
        "jax-sph": Family(
            MappingProxyType({-1: PADDING, 0: "fluid", 1: "wall", 2: "moving wall", 3: "heated wall"}),
            frozenset({1, 3}),
        ),
    }
)


def find_family(name: str) -> Family:
    """The family with a name.

    Raises:
        ConfigError: if there is no such family; lists the known ones.
    """
    if name not in FAMILIES:
        raise ConfigError(f"No family of particle types is called {name!r}; known: {', '.join(sorted(FAMILIES))}.")
    return FAMILIES[name]
