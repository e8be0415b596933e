"""Facts that all trajectories of a dataset share, and the meaning of type ids in published families of datasets.

A dataset's `metadata.json` (`nmpm.data.metadata_json`) holds these facts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from nmpm.errors import ConfigError, DataError
from nmpm.scene import Boundary, Interval, Scene

METADATA_FILE = "metadata.json"
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


def unambiguous_family(particle_type: np.ndarray) -> str | None:
    """The family that type ids are of; None where several give them different meanings, or none any.

    DeepMind's have materials that the others lack; fluids and walls without further types mean the same in the others.
    """
    ids = set(np.unique(particle_type).tolist())
    if ids <= set(FAMILIES["deepmind"].types) and ids & {5, 6, 7}:
        return "deepmind"
    return "lagrangebench" if ids <= {-1, 0, 1, 2} else None


@dataclass(frozen=True)
class Metadata:
    """Facts that all trajectories of a dataset share; lengths in domain length, times in seconds."""

    bounds: tuple[Interval, ...]  # where particles may be, (lower, upper) per axis
    dt: float  # time between stored frames (LagrangeBench's `dt` times its `write_every`)
    dim: int
    sequence_length: int  # frames per trajectory as the dataset declares them
    particle_types: dict[int, str]  # name of each type id
    static_types: frozenset[int] = frozenset()  # ids of the types that do not move
    prescribed_types: frozenset[int] = frozenset()  # ids of obstacles that move as recorded; taken out of static_types
    boundary: tuple[Boundary, ...] = ()  # per axis; walls when left out
    domain: tuple[Interval, ...] | None = None  # what a grid should cover, (lower, upper) per axis
    gravity: tuple[float, ...] | None = None  # acceleration in length/s² per axis; None where unknown
    particle_volume: float | None = None  # in length ** dim; None where unknown
    densities: dict[str, float] = field(default_factory=dict)  # of materials, in kg / length ** dim, where known
    fields: tuple[str, ...] = ()  # names of the fields that every trajectory has, which are inputs of models
    extra: dict[str, Any] = field(default_factory=dict)  # every other key of the file, unchanged

    def __post_init__(self) -> None:
        if not self.boundary:
            object.__setattr__(self, "boundary", ("wall",) * self.dim)
        object.__setattr__(self, "static_types", self.static_types - self.prescribed_types)

    @property
    def periodic(self) -> tuple[bool, ...]:
        """Whether each axis wraps."""
        return tuple(kind == "periodic" for kind in self.boundary)

    @property
    def obstacle_types(self) -> frozenset[int]:
        """Ids of the types that are not predicted: static, or moving as recorded."""
        return self.static_types | self.prescribed_types

    @property
    def moving_types(self) -> tuple[int, ...]:
        """Ids of the materials, which move and are predicted, in order of id."""
        names = self.particle_types
        return tuple(sorted(i for i in names if i not in self.obstacle_types and names[i] != PADDING))

    def is_moving(self, particle_type: np.ndarray) -> np.ndarray:
        """(N,) bool, of (N,) type ids."""
        return np.isin(particle_type, self.moving_types)

    def is_static(self, particle_type: np.ndarray) -> np.ndarray:
        """(N,) bool, of (N,) type ids."""
        return np.isin(particle_type, list(self.static_types))

    def is_obstacle(self, particle_type: np.ndarray) -> np.ndarray:
        """(N,) bool, of (N,) type ids: static, or moving as recorded."""
        return np.isin(particle_type, list(self.obstacle_types))

    def unknown_types(self, particle_type: np.ndarray) -> list[int]:
        """Ids in an array that have no name, ascending."""
        return sorted(set(np.unique(particle_type).tolist()) - set(self.particle_types))

    def check_types(self, particle_type: np.ndarray, where: str) -> None:
        """Raises a DataError that names unknown type ids in an array, and `where` they occur."""
        if unknown := self.unknown_types(particle_type):
            named = ", ".join(f"{i} {name}" for i, name in sorted(self.particle_types.items()))
            raise DataError(
                f"{where}: unknown particle type {', '.join(map(str, unknown))} (known: {named}). Name it: --types"
                f" {unknown[0]}=sand (to fit, in a copy: nmpm convert DATA NEW --types {unknown[0]}=sand), or in"
                f' {METADATA_FILE}, "particle_types": {{"{unknown[0]}": "sand"}}; or state another family:'
                f" --family {' or '.join(sorted(FAMILIES))}."
            )


def scene_metadata(scene: Scene, types: dict[int, str], static_type: int | None) -> Metadata:
    """The metadata of trajectories of a scene whose type ids have these names; their length is still to be set."""
    obstacle = frozenset() if static_type is None else frozenset({static_type})
    return Metadata(
        bounds=scene.bounds,
        dt=scene.dt,
        dim=scene.dim,
        sequence_length=1,
        particle_types=types,
        static_types=obstacle,
        prescribed_types=obstacle if scene.moving_obstacles else frozenset(),
        boundary=scene.boundary,
        domain=scene.domain,
        gravity=scene.gravity,
        particle_volume=scene.particle_volume,
        densities=dict(zip(scene.materials, scene.densities, strict=True)) if scene.densities else {},
        fields=scene.fields,
    )
