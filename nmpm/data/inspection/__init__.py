"""Summarises a dataset and reports its anomalies, in one pass over the trajectories."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType

import numpy as np
from scipy.spatial import cKDTree

from nmpm._support.progress import progress_bar
from nmpm.data.fields import FieldFacts, Kind, add_fields
from nmpm.data.format import Metadata, Split
from nmpm.data.gravity import distinct_gravities, trajectory_gravity
from nmpm.data.inspection.measurements import Measurements, find_anomalies
from nmpm.data.inspection.reading import open_dataset
from nmpm.data.inspection.report import Inspection, Range, SplitFacts
from nmpm.data.loading.sources import FolderSource
from nmpm.data.statistics import MotionStatistics, find_disagreements
from nmpm.errors import DataError, NmpmError
from nmpm.scene import Scene

_BYTES = 2**28  # of positions per split that are read by default
_MOST_FINDINGS = 12
_DIFFERS: Mapping[Kind, str] = MappingProxyType(
    {
        "evolving": "evolves",
        "property": "differs between particles",
        "parameter": "differs between trajectories",
        "constant": "is the same everywhere",
    }
)


def inspect(source: FolderSource, trajectories: int | None = None) -> Inspection:
    """Inspects a dataset, with a progress bar; what `nmpm fit` would refuse becomes a finding.

    Args:
        source: The dataset, and what the user states about it.
        trajectories: Number of evenly spaced trajectories of each split to read; about 256 MiB when left out.

    Raises:
        DataError: if there is no dataset, or no trajectory can be read.
    """
    data = open_dataset(source)
    metadata, splits, findings = data.metadata, data.splits, list(data.problems)
    scene: Scene | None = None
    try:
        scene = data.source.scene
    except NmpmError as error:
        if not data.wrong_metadata:
            findings.append(str(error))
    domain = scene.domain if scene else metadata.domain or metadata.bounds
    counts = _Counts(splits, metadata)
    findings += counts.problems
    sample = [(name, split, index) for name, split in splits.items() for index in _spread_evenly(split, trajectories)]
    measured, statistics = Measurements(metadata, domain), MotionStatistics(metadata)
    spacing, first = _spacing(sample, metadata), next(iter(splits))
    shapes: dict[str, tuple[int, ...]] = {}
    facts: dict[str, FieldFacts] = {}
    with progress_bar("Inspecting", len(sample)) as advance:
        for name, split, index in sample:
            try:
                trajectory = split.read(index)
                stored = {key: values.shape for key, values in split.fields(index).items()}
                shapes = shapes or stored
                sizes = (split.frames(index), split.particles(index))
                possible = [key for key, shape in stored.items() if shape in (sizes, sizes[1:], (1,), ())]
                add_fields(facts, split, index, metadata, dict.fromkeys((*metadata.fields, *possible)))
                findings += find_anomalies(trajectory, metadata, spacing, f"{name}, trajectory {split.names[index]}")
                measured.add(trajectory)
                if name == first:
                    statistics.add(trajectory)
            except DataError as error:
                findings.append(str(error))
            advance()
    if not np.isfinite(measured.observed).all():
        raise DataError(f"{data.source.folder}: none of its trajectories could be read. {findings[0]}")
    inspected = {name: sum(name == other for other, _, _ in sample) for name in splits}
    if inspected[first] == len(splits[first]):  # stated are those of the whole first split
        findings += find_disagreements(statistics.result(), metadata.extra)
    findings += counts.unexpected_lengths(metadata)
    occupied, occupied_each = measured.occupied()
    fall = np.median(measured.falls or [np.zeros(metadata.dim)], axis=0) / metadata.dt**2
    rests = [rest for rest in measured.rests if rest is not None]
    materials = scene.materials if scene else tuple(counts.materials)
    return Inspection(
        path=str(source.path),
        dim=metadata.dim,
        dt=metadata.dt,
        splits={name: counts.facts(name, number) for name, number in inspected.items()},
        materials={name: _range(numbers) for name, numbers in counts.materials.items()},
        stated_bounds=metadata.bounds,
        observed=tuple((float(low), float(high)) for low, high in measured.observed.T),
        domain=tuple(domain),
        boundary=scene.boundary if scene else tuple("periodic" if flag else "wall" for flag in metadata.periodic),
        gravity=scene.gravity if scene else metadata.gravity,
        first_acceleration=tuple(fall.tolist()),
        spacing=spacing,
        varies=(*counts.varies(), *(name for name, field in facts.items() if field.kind != "constant")),
        fields=shapes,
        grids=measured.grids(),
        recommended=measured.recommended(),
        occupied=occupied,
        occupied_each=occupied_each,
        rest=(int(np.median(rests)), min(rests), max(rests)) if rests else None,
        restless=len(measured.rests) - len(rests),
        notes=tuple(_notes(source, data.source, measured, metadata)),
        findings=tuple(_shorten(findings)),
        channels={name: _describe_channels(name, field, metadata, materials) for name, field in facts.items()},
    )


class _Counts:
    """Sizes, materials and gravities of all trajectories, read without their positions."""

    def __init__(self, splits: Mapping[str, Split], metadata: Metadata) -> None:
        self.frames: dict[str, list[int]] = {name: [] for name in splits}
        self.moving: dict[str, list[int]] = {name: [] for name in splits}
        self.static: dict[str, list[int]] = {name: [] for name in splits}
        self.materials: dict[str, list[int]] = {}
        self.gravities: list[tuple[float, ...] | None] = []
        self.problems: list[str] = []
        for name, split in splits.items():
            for index in range(len(split)):
                types = split.particle_type(index)
                self.frames[name].append(split.frames(index))
                self.moving[name].append(int(np.isin(types, metadata.moving_types).sum()))
                self.static[name].append(int(np.isin(types, list(metadata.static_types)).sum()))
                for number, count in zip(*np.unique(types, return_counts=True), strict=True):
                    self.materials.setdefault(metadata.particle_types[int(number)], []).append(int(count))
                try:
                    self.gravities.append(trajectory_gravity(split.attributes(index), metadata, split.where(index)))
                except DataError as error:
                    self.problems.append(str(error))

    def facts(self, name: str, inspected: int) -> SplitFacts:
        """The facts about a split."""
        ranges = (_range(numbers[name]) for numbers in (self.frames, self.moving, self.static))
        return SplitFacts(len(self.frames[name]), inspected, *ranges)

    def varies(self) -> tuple[str, ...]:
        """What differs between trajectories."""
        total = sum(map(len, self.frames.values()))
        differing = {
            "gravity": len(distinct_gravities(self.gravities)) > 1,
            "materials": any(len(counts) < total for counts in self.materials.values()),
            "particles": len({n for counts in self.moving.values() for n in counts}) > 1,
            "frames": len({n for counts in self.frames.values() for n in counts}) > 1,
            "obstacles": len({n for counts in self.static.values() for n in counts}) > 1,
        }
        return tuple(what for what, differs in differing.items() if differs)

    def unexpected_lengths(self, metadata: Metadata) -> list[str]:
        """A sentence on numbers of frames that are not as the metadata state."""
        stated = [metadata.extra.get(f"sequence_length_{name}") for name in self.frames]
        lengths = [metadata.sequence_length, *(value for value in stated if isinstance(value, int))]
        # Files often have one frame more than stated.
        expected = {length + more for length in lengths for more in (0, 1)}
        unexpected = {n for counts in self.frames.values() for n in counts} - expected
        if not unexpected:
            return []
        span = f"{min(unexpected)}" if len(unexpected) == 1 else f"{min(unexpected)} to {max(unexpected)}"
        return [f"The metadata state sequence_length {metadata.sequence_length}; trajectories have {span} frames."]


def _range(values: list[int]) -> Range:
    return min(values), max(values)


def _spread_evenly(split: Split, trajectories: int | None) -> range:
    """Indices of evenly spaced trajectories."""
    if trajectories is None:
        size = sum(4 * split.frames(i) * split.particles(i) * split.dim for i in range(len(split)))
        trajectories = max(1, int(len(split) * min(1.0, _BYTES / size)))
    return range(0, len(split), max(1, -(-len(split) // trajectories)))


def _spacing(sample: list[tuple[str, Split, int]], metadata: Metadata) -> float:
    """Median distance to the nearest particle in the first frames of a few trajectories."""
    medians = []
    for _, split, index in sample[:8]:
        try:
            first = split.read(index, 0, 1)
        except DataError:
            continue
        position = first.position[0, np.isin(first.particle_type, metadata.moving_types)]
        if len(position) > 1:
            medians.append(float(np.median(cKDTree(position).query(position, k=2)[0][:, 1])))
    lower, upper = np.asarray(metadata.bounds).T
    return float(np.median(medians)) if medians and np.median(medians) > 0 else float((upper - lower).max()) / 64


def _describe_channels(name: str, field: FieldFacts, metadata: Metadata, materials: tuple[str, ...]) -> str:
    """How a field varies, and the input channels that it makes."""
    if field.kind == "constant":
        return f"{_DIFFERS[field.kind]}, {field.low:.4g}: no channel"
    varies = f"{_DIFFERS[field.kind]}, {field.low:.4g}…{field.high:.4g}"
    if name not in metadata.fields:
        return f"{varies}; not declared: no channel (--data.fields)"
    channels = name if field.kind == "parameter" else ", ".join(f"{material}.{name}" for material in materials)
    return f"{varies}: {channels}{', predicted' if field.kind == 'evolving' else ''}"


def _notes(stated: FolderSource, source: FolderSource, measured: Measurements, metadata: Metadata) -> Iterator[str]:
    family = source.options.family
    if family != stated.options.family:
        yield (
            f"The metadata do not state what the particle types mean; they are read as those of the {family} family, by"
            f" the ids that occur. If that is right, add --family {family}; nmpm fit needs --data.family {family}."
        )
    for axis, (low, high) in enumerate(metadata.bounds):
        seen_low, seen_high = measured.observed[:, axis].tolist()
        if not metadata.periodic[axis] and (seen_low < low or seen_high > high):
            yield (
                f"Along {'xyz'[axis]} positions reach from {seen_low:.4f} to {seen_high:.4f}, beyond the stated bounds"
                f" {low:g} to {high:g}; the domain was chosen to contain them."
            )
    notes = metadata.extra.get("conversion")
    yield from [note for note in notes if isinstance(note, str)] if isinstance(notes, list) else []


def _shorten(findings: list[str]) -> list[str]:
    more = len(findings) - _MOST_FINDINGS
    return findings if more <= 0 else [*findings[:_MOST_FINDINGS], f"… and {more} more."]
