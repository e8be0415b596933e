"""Inspects a dataset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from nmpm._support.progress import progress_bar
from nmpm.data.format import Metadata, Split
from nmpm.data.inspection.anomalies import find_anomalies
from nmpm.data.inspection.facts import Inspection, Range, SplitFacts
from nmpm.data.inspection.field_survey import FieldSurvey
from nmpm.data.inspection.survey import Survey
from nmpm.data.inspection.tolerance import open_splits, tolerant_metadata, with_guessed_family
from nmpm.data.loading.sources import FolderSource
from nmpm.data.scene_inference import distinct_gravities, trajectory_gravity
from nmpm.data.statistics import MotionStatistics, find_disagreements
from nmpm.errors import DataError, NmpmError
from nmpm.scene import Scene

_BYTES = 2**28  # of positions per split that are read by default
_MOST_FINDINGS = 12


@dataclass
class _Tally:
    """Sizes, materials and gravities of all trajectories, read without their positions."""

    frames: dict[str, list[int]] = field(default_factory=dict)
    moving: dict[str, list[int]] = field(default_factory=dict)
    static: dict[str, list[int]] = field(default_factory=dict)
    materials: dict[str, list[int]] = field(default_factory=dict)
    gravities: list[tuple[float, ...] | None] = field(default_factory=list)


def inspect(origin: FolderSource, trajectories: int | None = None) -> Inspection:
    """Inspects a dataset, with a progress bar; what `nmpm fit` would refuse becomes a finding.

    Args:
        origin: The dataset, and what the user states about it.
        trajectories: Number of evenly spaced trajectories of each split to read; about 256 MiB when left out.

    Raises:
        DataError: if there is no dataset, or no trajectory can be read.
    """
    path = origin.path
    splits, findings = open_splits(origin.folder)
    family, origin = origin.stated.family, with_guessed_family(origin)
    metadata, wrong = tolerant_metadata(origin, splits)
    findings += wrong
    if origin.stated.fields is not None:
        metadata = replace(metadata, fields=tuple(origin.stated.fields))
    scene: Scene | None = None
    try:
        scene = origin.scene
    except NmpmError as error:
        if not wrong:
            findings.append(str(error))
    tally = _tally(splits, metadata)
    domain = scene.domain if scene else metadata.domain or metadata.bounds
    survey, first = Survey(metadata, domain), next(iter(splits))
    chosen = {name: _spread_evenly(split, trajectories) for name, split in splits.items()}
    statistics = MotionStatistics(metadata)
    spacing = _spacing(splits, chosen, metadata)
    fields: dict[str, tuple[int, ...]] = {}
    field_survey = FieldSurvey(metadata)
    with progress_bar("Inspecting", sum(map(len, chosen.values()))) as advance:
        for where, split, index in _each(splits, chosen):
            try:
                trajectory = split.read(index)
                stored = {key: values.shape for key, values in split.fields(index).items()}
                fields = fields or stored
                field_survey.add(split, index, stored)
                findings += find_anomalies(trajectory, metadata, spacing, where)
                survey.add(trajectory)
                if split is splits[first]:
                    statistics.add(trajectory)
            except DataError as error:
                findings.append(str(error))
            advance()
    if not np.isfinite(survey.observed).all():
        raise DataError(f"{origin.folder}: none of its trajectories could be read. {findings[0]}")
    if len(chosen[first]) == len(splits[first]):  # stated are those of the whole first split
        findings += find_disagreements(statistics.result(), metadata.extra)
    findings += _lengths(tally, metadata)
    occupied, each = survey.occupied()
    fall = np.median(survey.falls or [np.zeros(metadata.dim)], axis=0) / metadata.dt**2
    rests = [rest for rest in survey.rests if rest is not None]
    return Inspection(
        path=str(path),
        dim=metadata.dim,
        dt=metadata.dt,
        splits={name: _split_facts(name, tally, len(chosen[name])) for name in splits},
        materials={name: _range(counts) for name, counts in tally.materials.items()},
        stated_bounds=metadata.bounds,
        observed=tuple((float(a), float(b)) for a, b in survey.observed.T),
        domain=tuple(domain),
        boundary=scene.boundary if scene else tuple("periodic" if flag else "wall" for flag in metadata.periodic),
        gravity=scene.gravity if scene else metadata.gravity,
        first_acceleration=tuple(fall.tolist()),
        spacing=spacing,
        varies=(*_varies(tally), *field_survey.varying),
        fields=fields,
        grids=survey.grids(),
        recommended=survey.recommended(),
        occupied=occupied,
        occupied_each=each,
        rest=(int(np.median(rests)), min(rests), max(rests)) if rests else None,
        restless=len(survey.rests) - len(rests),
        notes=(
            *_family_notes(origin, family),
            *_out_of_bounds_notes(survey, metadata),
            *_conversion_notes(metadata),
        ),
        findings=_truncate(findings),
        channels=field_survey.channels(scene.materials if scene else list(tally.materials)),
    )


def _each(splits: Mapping[str, Split], chosen: Mapping[str, range]) -> Iterator[tuple[str, Split, int]]:
    for name, split in splits.items():
        for index in chosen[name]:
            yield f"{name}, trajectory {split.names[index]}", split, index


def _spread_evenly(split: Split, trajectories: int | None) -> range:
    """Indices of evenly spaced trajectories."""
    if trajectories is None:
        size = sum(4 * split.frames(i) * split.particles(i) * split.dim for i in range(len(split)))
        trajectories = max(1, int(len(split) * min(1.0, _BYTES / size)))
    return range(0, len(split), max(1, -(-len(split) // trajectories)))


def _tally(splits: Mapping[str, Split], metadata: Metadata) -> _Tally:
    tally = _Tally()
    for name, split in splits.items():
        for index in range(len(split)):
            types = split.particle_type(index)
            tally.frames.setdefault(name, []).append(split.frames(index))
            tally.moving.setdefault(name, []).append(int(np.isin(types, metadata.moving_types).sum()))
            tally.static.setdefault(name, []).append(int(np.isin(types, list(metadata.static_types)).sum()))
            for number in np.unique(types).tolist():
                material = metadata.particle_types.get(number, f"type {number}")
                tally.materials.setdefault(material, []).append(int((types == number).sum()))
            tally.gravities.append(trajectory_gravity(split, index, metadata))
    return tally


def _spacing(splits: Mapping[str, Split], chosen: Mapping[str, range], metadata: Metadata) -> float:
    """Median distance to the nearest particle in the first frames of a few trajectories."""
    found = []
    for _, split, index in list(_each(splits, chosen))[:8]:
        try:
            first = split.read(index, 0, 1)
        except DataError:
            continue
        position = first.position[0, np.isin(first.particle_type, metadata.moving_types)]
        if len(position) > 1:
            found.append(float(np.median(cKDTree(position).query(position, k=2)[0][:, 1])))
    lower, upper = np.asarray(metadata.bounds).T
    return float(np.median(found)) if found and np.median(found) > 0 else float((upper - lower).max()) / 64


def _range(values: list[int]) -> Range:
    return min(values), max(values)


def _split_facts(name: str, tally: _Tally, inspected: int) -> SplitFacts:
    return SplitFacts(
        trajectories=len(tally.frames[name]),
        inspected=inspected,
        frames=_range(tally.frames[name]),
        particles=_range(tally.moving[name]),
        static=_range(tally.static[name]),
    )


def _varies(tally: _Tally) -> tuple[str, ...]:
    total = sum(map(len, tally.frames.values()))
    differing = {
        "gravity": len(distinct_gravities(tally.gravities)) > 1,
        "materials": any(len(counts) < total for counts in tally.materials.values()),
        "particles": len({n for counts in tally.moving.values() for n in counts}) > 1,
        "frames": len({n for counts in tally.frames.values() for n in counts}) > 1,
        "obstacles": len({n for counts in tally.static.values() for n in counts}) > 1,
    }
    return tuple(what for what, differs in differing.items() if differs)


def _lengths(tally: _Tally, metadata: Metadata) -> list[str]:
    stated = [metadata.extra.get(f"sequence_length_{name}") for name in tally.frames]
    lengths = [metadata.sequence_length, *(value for value in stated if isinstance(value, int))]
    # Files often have one frame more than stated.
    unexpected = {n for counts in tally.frames.values() for n in counts} - {
        n + more for n in lengths for more in (0, 1)
    }
    if not unexpected:
        return []
    lengths_found = f"{min(unexpected)}" if len(unexpected) == 1 else f"{min(unexpected)} to {max(unexpected)}"
    return [f"The metadata state sequence_length {metadata.sequence_length}; trajectories have {lengths_found} frames."]


def _family_notes(origin: FolderSource, stated: str | None) -> list[str]:
    family = origin.stated.family
    if family == stated:
        return []
    return [
        f"The metadata do not state what the particle types mean; they are read as those of the {family} family, by"
        f" the ids that occur. If that is right, add --family {family}; nmpm fit needs --data.family {family}."
    ]


def _conversion_notes(metadata: Metadata) -> list[str]:
    notes = metadata.extra.get("conversion")
    return [note for note in notes if isinstance(note, str)] if isinstance(notes, list) else []


def _out_of_bounds_notes(survey: Survey, metadata: Metadata) -> list[str]:
    notes = []
    for axis, (low, high) in enumerate(metadata.bounds):
        seen_low, seen_high = survey.observed[:, axis].tolist()
        if not metadata.periodic[axis] and (seen_low < low or seen_high > high):
            notes.append(
                f"Along {'xyz'[axis]} positions reach from {seen_low:.4f} to {seen_high:.4f}, beyond the stated bounds"
                f" {low:g} to {high:g}; the domain was chosen to contain them."
            )
    return notes


def _truncate(findings: list[str]) -> tuple[str, ...]:
    if len(findings) <= _MOST_FINDINGS:
        return tuple(findings)
    return (*findings[:_MOST_FINDINGS], f"… and {len(findings) - _MOST_FINDINGS} more.")
