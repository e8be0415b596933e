"""Infers the scene of a dataset from its metadata and its trajectories."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nmpm.data.array_checks import particles_far_away
from nmpm.data.convert.base import Options
from nmpm.data.fields import FieldSurvey, require_fields
from nmpm.data.format import METADATA_FILE, SPLITS, Metadata, Split, find_split, read_metadata
from nmpm.data.gravity import check_gravity, common_gravity, distinct_gravities, trajectory_gravity
from nmpm.data.spacing import neighbour_distance
from nmpm.data.statistics import Extent, without_those_gone
from nmpm.errors import DataError
from nmpm.scene import Interval, Scene

WALL_LAYER = 0.025
"""Of the extent; DeepMind's 0.1-0.9 becomes the paper's 0.08-0.92."""


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
    stated, where = read_metadata(folder, options.family, options.types), folder / METADATA_FILE
    metadata = options.apply_to(stated)
    if options.gravity is not None:
        check_gravity(options.gravity, stated.gravity, where)
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
    if not types & set(metadata.moving_types):
        raise DataError(f"{split.path}: no particle has a moving type; check static_types in {METADATA_FILE}.")
    require_fields(split, metadata.fields)
    sample, fields = split.sample(), FieldSurvey(metadata)
    moving, everything = Extent(metadata.dim), Extent(metadata.dim)
    for index in sample:
        trajectory = split.read(index)
        moves = metadata.is_moving(trajectory.particle_type)
        position = without_those_gone(trajectory.position, metadata)
        if (far := particles_far_away(position)).any():  # an inspection names these
            position = np.where(far[..., None], np.nan, position)
        moving.add(position[:, moves])
        everything.add(position[:, moves | metadata.is_obstacle(trajectory.particle_type)])
        fields.add(split, index, metadata.fields)
    gravities = distinct_gravities(
        trajectory_gravity(split.attributes(index), metadata, split.where(index)) for index in range(len(split))
    )
    if options.gravity is not None:
        for other in gravities:
            check_gravity(options.gravity, other, split.path)
    volume = metadata.particle_volume or neighbour_distance(split, sample, metadata) ** metadata.dim
    if volume <= 0:
        raise DataError(
            f"{where}: the volume of a particle cannot be estimated from the distances between them;"
            ' add it, e.g. "particle_volume": 6.4e-5 (length ** dim).'
        )
    bounds, domain = zip(*_extents(metadata, moving.intervals, everything.intervals, where), strict=True)
    scene = metadata.scene(
        types,
        bounds=bounds,
        domain=domain,
        particle_volume=volume,
        gravity=common_gravity(gravities, metadata, split),
        gravity_varies=len(gravities) > 1,
        evolving=fields.names("evolving"),
        properties=fields.names("property"),
        parameters=fields.names("parameter"),
    )
    densities = tuple(metadata.densities[name] for name in scene.materials if name in metadata.densities)
    return replace(scene, densities=densities) if 1 < len(densities) == len(scene.materials) else scene


def _extents(
    metadata: Metadata, moving: Sequence[Interval], everything: Sequence[Interval], where: Path
) -> Iterator[tuple[Interval, Interval]]:
    """Yields bounds and domain, (lower, upper) each, of each axis."""
    for axis, (bounds, kind) in enumerate(zip(metadata.bounds, metadata.boundary, strict=True)):
        (low, high), (lowest, highest), domain = bounds, everything[axis], metadata.domain and metadata.domain[axis]
        if kind == "periodic":
            if domain and not np.allclose(bounds, domain, rtol=0, atol=1e-6 * (domain[1] - domain[0])):
                raise DataError(
                    f"{where}: axis {axis} is periodic, but its bounds {list(bounds)} and domain {list(domain)} have"
                    " different ends. Make them the same, one period apart, or leave the domain out, so that the"
                    " bounds are the period."
                )
            yield domain or bounds, domain or bounds
            continue
        if kind == "open":
            yield bounds, domain or bounds
            continue
        if domain and (lowest < domain[0] or highest > domain[1]):
            raise DataError(
                f"{where}: domain {list(domain)} on axis {axis} does not contain the positions, which reach from"
                f" {lowest:.6g} to {highest:.6g}. Widen it."
            )
        layer = WALL_LAYER * (high - low)
        # If particles are beyond the layer, the stated bounds are not the walls: put the layer around the particles.
        lower = low - layer if lowest >= low - layer else lowest - layer
        upper = high + layer if highest <= high + layer else highest + layer
        yield (min(low, moving[axis][0]), max(high, moving[axis][1])), domain or (lower, upper)
