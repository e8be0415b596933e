"""Infers the scene of a dataset from its metadata and its trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nmpm.data.array_checks import particles_far_away
from nmpm.data.convert.base import Options
from nmpm.data.fields import FieldFacts, Kind, add_fields, require_fields
from nmpm.data.format import METADATA_FILE, Metadata, Split, read_metadata
from nmpm.data.gravity import check_gravity, common_gravity, distinct_gravities, trajectory_gravity
from nmpm.data.split_files import SPLITS, find_split
from nmpm.data.statistics import Extent, neighbour_distance, without_those_gone
from nmpm.errors import DataError
from nmpm.scene import Interval, Scene

_WALL_LAYER = 0.025  # of the extent; DeepMind's 0.1-0.9 becomes the paper's 0.08-0.92
_SAMPLE_BYTES = 2**27


def infer_scene(folder: Path, options: Options | None = None) -> Scene:
    """Infers the scene of a dataset in the native layout.

    Bounds are the metadata's, widened to contain all sampled positions of moving particles. The domain is the
    metadata's, or else the metadata's bounds with a wall layer of 2.5% of their extent (further out where particles
    are), and the bounds themselves on a periodic or open axis; particles that leave those of an open axis are gone.
    Materials are the types that move and occur, in order of id. The particle volume is the metadata's, or else (median
    distance to the nearest neighbour in first frames) ** dim. Fields are those that the metadata or the user names and
    that differ anywhere in the sample.

    Sampled are the positions and fields of `train.h5` (or else `valid.h5`, `test.h5`): all of them up to 128 MiB,
    evenly spaced trajectories beyond that. Types and gravities are read from all its trajectories.

    Raises:
        DataError: if files are missing or wrong, a trajectory lacks a field, a position lies outside the domain that
            the metadata states, that domain is not the period of a periodic axis, or all trajectories contradict the
            metadata's gravity.
        ConfigError: if an option does not match the number of axes, is invalid, or contradicts the files' gravity.
    """
    folder, options = Path(folder), options or Options()
    stated = read_metadata(folder, options.family, options.types)
    metadata = options.apply_to(stated)
    if options.gravity is not None:
        check_gravity(options.gravity, stated.gravity, folder / METADATA_FILE)
    split = Split(find_split(folder, *SPLITS))
    if split.dim != metadata.dim:
        raise DataError(
            f"{split.path}: positions have {split.dim} dimensions, {METADATA_FILE} has dim = {metadata.dim}."
        )
    types: set[int] = set()
    for index in range(len(split)):
        particle_type = split.particle_type(index)
        metadata.check_types(particle_type, split.where(index))
        types.update(np.unique(particle_type).tolist())
    sample = split.sample(_SAMPLE_BYTES)
    moving, everything = Extent(metadata.dim), Extent(metadata.dim)
    for index in sample:
        trajectory = split.read(index)
        moves, is_obstacle = (
            metadata.is_moving(trajectory.particle_type),
            metadata.is_obstacle(trajectory.particle_type),
        )
        position = without_those_gone(trajectory.position, metadata)
        if (far := particles_far_away(position)).any():  # an inspection names these
            position = np.where(far[..., None], np.nan, position)
        moving.add(position[:, moves])
        everything.add(position[:, moves | is_obstacle])
    bounds, domain = _extents(metadata, moving, everything, folder)
    gravities = distinct_gravities(
        trajectory_gravity(split.attributes(index), metadata, split.where(index)) for index in range(len(split))
    )
    if options.gravity is not None:
        for other in gravities:
            check_gravity(options.gravity, other, split.path)
    materials = tuple(dict.fromkeys(metadata.particle_types[i] for i in metadata.moving_types if i in types))
    if not materials:
        raise DataError(f"{split.path}: no particle has a moving type; check static_types in {METADATA_FILE}.")
    densities = tuple(metadata.densities[name] for name in materials if name in metadata.densities)
    kinds = _kinds_of_fields(split, sample, metadata)
    volume = metadata.particle_volume or neighbour_distance(split, sample, metadata) ** metadata.dim
    if volume <= 0:
        raise DataError(
            f"{folder / METADATA_FILE}: the volume of a particle cannot be estimated from the distances between them;"
            ' add it, e.g. "particle_volume": 6.4e-5 (length ** dim).'
        )
    return Scene(
        bounds=bounds,
        domain=domain,
        dt=metadata.dt,
        materials=materials,
        particle_volume=volume,
        boundary=metadata.boundary,
        gravity=common_gravity(gravities, metadata, split),
        gravity_varies=len(gravities) > 1,
        obstacles=bool(types & metadata.obstacle_types),
        moving_obstacles=bool(types & metadata.prescribed_types),
        densities=densities if 1 < len(densities) == len(materials) else (),
        evolving=tuple(name for name, kind in kinds.items() if kind == "evolving"),
        properties=tuple(name for name, kind in kinds.items() if kind == "property"),
        parameters=tuple(name for name, kind in kinds.items() if kind == "parameter"),
    )


def _kinds_of_fields(split: Split, sample: range, metadata: Metadata) -> dict[str, Kind]:
    """The kinds of the declared fields, in their order."""
    require_fields(split, metadata.fields)
    facts: dict[str, FieldFacts] = {}
    for index in sample if metadata.fields else ():
        add_fields(facts, split, index, metadata, metadata.fields)
    return {name: facts[name].kind for name in metadata.fields}


def _extents(
    metadata: Metadata, moving: Extent, everything: Extent, folder: Path
) -> tuple[tuple[Interval, ...], tuple[Interval, ...]]:
    """Bounds and domain, (lower, upper) per axis."""
    stated = metadata.domain or (None,) * metadata.dim
    pairs = list[tuple[Interval, Interval]]()
    for axis, (bounds, kind) in enumerate(zip(metadata.bounds, metadata.boundary, strict=True)):
        if kind == "periodic":
            pairs.append(_periodic_extent(bounds, stated[axis], axis, folder))
        elif kind == "open":
            pairs.append((bounds, stated[axis] or bounds))
        else:
            seen = moving.intervals[axis], everything.intervals[axis]
            pairs.append(_walled_extent(bounds, stated[axis], *seen, axis, folder))
    return tuple(pair[0] for pair in pairs), tuple(pair[1] for pair in pairs)


def _periodic_extent(bounds: Interval, stated: Interval | None, axis: int, folder: Path) -> tuple[Interval, Interval]:
    if stated is not None and not np.allclose(bounds, stated, rtol=0, atol=1e-6 * (stated[1] - stated[0])):
        raise DataError(
            f"{folder / METADATA_FILE}: axis {axis} is periodic, but its bounds {list(bounds)} and domain"
            f" {list(stated)} have different ends. Make them the same, one period apart, or leave the domain out, so"
            " that the bounds are the period."
        )
    return stated or bounds, stated or bounds


def _walled_extent(
    bounds: Interval, stated: Interval | None, moving: Interval, everything: Interval, axis: int, folder: Path
) -> tuple[Interval, Interval]:
    low, high = bounds
    seen_low, seen_high = everything
    widened = (min(low, moving[0]), max(high, moving[1]))
    if stated is not None:
        if seen_low < stated[0] or seen_high > stated[1]:
            raise DataError(
                f"{folder / METADATA_FILE}: domain {list(stated)} on axis {axis} does not contain the positions, which"
                f" reach from {seen_low:.6g} to {seen_high:.6g}. Widen it."
            )
        return widened, stated
    layer = _WALL_LAYER * (high - low)
    # If particles are beyond the layer, the stated bounds are not the walls: put the layer around the particles.
    lower = low - layer if seen_low >= low - layer else seen_low - layer
    upper = high + layer if seen_high <= high + layer else seen_high + layer
    return widened, (lower, upper)
