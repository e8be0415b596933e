"""Summarises a dataset and reports its anomalies, in one pass over the trajectories."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from nmpm._support.progress import progress_bar
from nmpm.data.array_checks import check_end
from nmpm.data.facts import FOUND
from nmpm.data.fields import FieldFacts, Kind, add_fields
from nmpm.data.format import Metadata, Split
from nmpm.data.gravity import distinct_gravities, trajectory_gravity
from nmpm.data.grid_rule import GridFacts, candidates, recommended_cells
from nmpm.data.inspection.dataset_checks import DatasetChecks
from nmpm.data.inspection.findings import Finding, Severity, sort_findings
from nmpm.data.inspection.measurements import Measurements
from nmpm.data.inspection.reading import open_dataset
from nmpm.data.inspection.shared_runs import find_shared_runs
from nmpm.data.loading.sources import FolderSource
from nmpm.data.statistics import MotionStatistics, find_disagreements, neighbour_distance, notes_on_lengths
from nmpm.errors import DataError, NmpmError
from nmpm.scene import Interval, Scene

Range = tuple[int, int]
"""Smallest and largest value."""
_BYTES = 2**28  # of positions per split that are read by default
_DIFFERS: Mapping[Kind, str] = MappingProxyType(
    {
        "evolving": "evolves",
        "property": "differs between particles",
        "parameter": "differs between trajectories",
        "constant": "is the same everywhere",
    }
)


@dataclass(frozen=True)
class SplitFacts:
    """Facts about one split."""

    trajectories: int
    inspected: int  # trajectories that were read
    frames: Range  # of a trajectory, as the following
    particles: Range  # those that move
    static: Range


@dataclass(frozen=True)
class Inspection:
    """The results of an inspection; lengths in domain length, times in seconds."""

    path: str
    dim: int
    dt: float
    splits: dict[str, SplitFacts]
    materials: dict[str, Range]  # particles of each in a trajectory
    stated_bounds: tuple[Interval, ...]
    observed: tuple[Interval, ...]  # extent of all positions
    domain: tuple[Interval, ...]  # extent that a grid should cover
    boundary: tuple[str, ...]  # "wall" or "periodic" per axis
    gravity: tuple[float, ...] | None  # in length/s², where it is known and the same for all trajectories
    first_acceleration: tuple[float, ...]  # median in the first frames, in length/s²; gravity in free fall
    spacing: float  # median distance to the nearest neighbour in first frames
    varies: tuple[str, ...]  # between trajectories: gravity, materials, particles, frames, obstacles, or a field
    fields: dict[str, tuple[int, ...]]  # shape of each further array, in the first trajectory
    grids: tuple[GridFacts, ...]
    recommended: int  # cells along the longest side
    occupied: float  # fraction of the domain that a particle ever visits, in all trajectories together
    occupied_each: float  # the same in one trajectory, median
    rest: tuple[int, int, int] | None  # first frame at rest: median, smallest, largest; None where none comes to rest
    restless: int  # trajectories that still move at their end
    found: dict[str, str]  # facts that were found in the trajectories by the conversion: how, and how sure
    notes: tuple[str, ...]  # they need no action
    findings: tuple[Finding, ...]  # contradictions first; of each trajectory
    channels: dict[str, str]  # for each field how it differs, and the input channels that it makes


def inspect(source: FolderSource, trajectories: int | None = None) -> Inspection:
    """Inspects a dataset, with a progress bar; what `nmpm fit` would refuse becomes a finding.

    Args:
        source: The dataset, and what the user states about it.
        trajectories: Number of evenly spaced trajectories of each split to read; about 256 MiB when left out.

    Raises:
        DataError: if there is no dataset, or no trajectory can be read.
    """
    data = open_dataset(source)
    metadata, splits = data.metadata, data.splits
    problems = [Finding("metadata", Severity.CONTRADICTION, problem) for problem in data.problems]
    scene: Scene | None = None
    try:
        scene = data.source.scene
    except NmpmError as error:
        if not data.wrong_metadata:
            problems.append(Finding("metadata", Severity.CONTRADICTION, str(error)))
    domain = scene.domain if scene else metadata.domain or metadata.bounds
    counts = _Counts(splits, metadata)
    problems += [Finding("metadata", Severity.CONTRADICTION, problem) for problem in counts.problems]
    samples = {
        name: split.sample(_BYTES) if trajectories is None else range(0, len(split), -(-len(split) // trajectories))
        for name, split in splits.items()
    }
    first = next(iter(splits))
    spacing = neighbour_distance(splits[first], samples[first], metadata)
    spacing = spacing or max(high - low for low, high in metadata.bounds) / 64
    numbers = candidates(domain, scene.particle_spacing if scene else spacing)
    measured, statistics = Measurements(metadata, domain, numbers), MotionStatistics(metadata)
    checks = DatasetChecks(metadata)
    shapes: dict[str, tuple[int, ...]] = {}
    facts: dict[str, FieldFacts] = {}
    with progress_bar("Inspecting", sum(map(len, samples.values()))) as advance:
        for name, index in ((name, index) for name, sample in samples.items() for index in sample):
            split = splits[name]
            try:
                trajectory = split.read_with_fields(index)
                moving = metadata.is_moving(trajectory.particle_type)
                check_end(trajectory.position[:, moving], split.where(index))
                stored = {key: values.shape for key, values in trajectory.fields.items()}
                shapes = shapes or stored
                sizes = (split.frames(index), split.particles(index))
                possible = [key for key, shape in stored.items() if shape in (sizes, sizes[1:], (1,), ())]
                add_fields(facts, split, index, metadata, dict.fromkeys((*metadata.fields, *possible)))
                checks.add(trajectory, f"{name} {split.names[index]}")
                measured.add(trajectory)
                if name == first:
                    statistics.add(trajectory)
            except DataError as error:
                problems.append(Finding("unreadable", Severity.CONTRADICTION, str(error)))
            advance()
    if not np.isfinite(measured.observed.lower).all():
        raise DataError(f"{data.source.folder}: none of its trajectories could be read. {problems[0].sentence}")
    findings = [*problems, *find_shared_runs(splits, metadata, spacing), *checks.result()]
    if len(samples[first]) == len(splits[first]):  # stated are those of the whole first split
        differences = find_disagreements(statistics.result(), metadata.extra)
        findings += [Finding("statistics", Severity.ODDITY, sentence) for sentence in differences]
    stated = [metadata.extra.get(f"sequence_length_{name}") for name in splits]
    if "sequence_length" not in metadata.extra.get(FOUND, {}):
        lengths = notes_on_lengths(counts.frames, metadata, [length for length in stated if isinstance(length, int)])
        findings += [Finding("sequence length", Severity.NOTE, sentence) for sentence in lengths]
    occupied, occupied_each = measured.occupied()
    fall = np.median(measured.falls or [np.zeros(metadata.dim)], axis=0) / metadata.dt**2
    rests = [rest for rest in measured.rests if rest is not None]
    materials = scene.materials if scene else tuple(counts.materials)
    return Inspection(
        path=str(source.path),
        dim=metadata.dim,
        dt=metadata.dt,
        splits={name: counts.facts(name, len(sample)) for name, sample in samples.items()},
        materials={name: _range(numbers) for name, numbers in counts.materials.items()},
        stated_bounds=metadata.bounds,
        observed=measured.observed.intervals,
        domain=tuple(domain),
        boundary=scene.boundary if scene else metadata.boundary,
        gravity=scene.gravity if scene else metadata.gravity,
        first_acceleration=tuple(fall.tolist()),
        spacing=spacing,
        varies=(*counts.varies(), *(name for name, field in facts.items() if field.kind != "constant")),
        fields=shapes,
        grids=measured.grids(),
        recommended=recommended_cells(measured.grids(), counts.most_moving),
        occupied=occupied,
        occupied_each=occupied_each,
        rest=(int(np.median(rests)), min(rests), max(rests)) if rests else None,
        restless=len(measured.rests) - len(rests),
        found=dict(metadata.extra.get(FOUND, {})),
        notes=tuple(_notes(source, data.source, metadata)),
        findings=sort_findings(findings),
        channels={name: _describe_channels(name, field, metadata, materials) for name, field in facts.items()},
    )


class _Counts:
    """Sizes, materials and gravities of all trajectories, read without their positions."""

    def __init__(self, splits: Mapping[str, Split], metadata: Metadata) -> None:
        self.sizes: dict[str, list[tuple[int, int, int]]] = {name: [] for name in splits}
        self.materials: dict[str, list[int]] = {}
        self.gravities: list[tuple[float, ...] | None] = []
        self.problems: list[str] = []
        for name, split in splits.items():
            for index in range(len(split)):
                types = split.particle_type(index)
                moving, static = int(metadata.is_moving(types).sum()), int(metadata.is_obstacle(types).sum())
                self.sizes[name].append((split.frames(index), moving, static))
                for number, count in zip(*np.unique(types, return_counts=True), strict=True):
                    self.materials.setdefault(metadata.particle_types[int(number)], []).append(int(count))
                try:
                    self.gravities.append(trajectory_gravity(split.attributes(index), metadata, split.where(index)))
                except DataError as error:
                    self.problems.append(str(error))

    @property
    def frames(self) -> set[int]:
        """Numbers of frames that occur."""
        return {frames for sizes in self.sizes.values() for frames, _, _ in sizes}

    @property
    def most_moving(self) -> int:
        """Moving particles in a trajectory, at most."""
        return max(moving for sizes in self.sizes.values() for _, moving, _ in sizes)

    def facts(self, name: str, inspected: int) -> SplitFacts:
        """The facts about a split."""
        return SplitFacts(len(self.sizes[name]), inspected, *map(_range, zip(*self.sizes[name], strict=True)))

    def varies(self) -> tuple[str, ...]:
        """What differs between trajectories."""
        sizes = [size for sizes in self.sizes.values() for size in sizes]
        differing = {
            "gravity": len(distinct_gravities(self.gravities)) > 1,
            "materials": any(len(counts) < len(sizes) for counts in self.materials.values()),
            "particles": len({moving for _, moving, _ in sizes}) > 1,
            "frames": len(self.frames) > 1,
            "obstacles": len({static for _, _, static in sizes}) > 1,
        }
        return tuple(what for what, differs in differing.items() if differs)


def _range(values: Sequence[int]) -> Range:
    return min(values), max(values)


def _describe_channels(name: str, field: FieldFacts, metadata: Metadata, materials: tuple[str, ...]) -> str:
    """How a field varies, and the input channels that it makes."""
    if field.kind == "constant":
        return f"{_DIFFERS[field.kind]}, {field.low:.4g}: no channel"
    varies = f"{_DIFFERS[field.kind]}, {field.low:.4g}…{field.high:.4g}"
    if name not in metadata.fields:
        return f"{varies}; not declared: no channel (--data.fields)"
    channels = name if field.kind == "parameter" else ", ".join(f"{material}.{name}" for material in materials)
    return f"{varies}: {channels}{', predicted' if field.kind == 'evolving' else ''}"


def _notes(stated: FolderSource, source: FolderSource, metadata: Metadata) -> Iterator[str]:
    family = source.options.family
    if family != stated.options.family:
        yield (
            f"The metadata do not state what the particle types mean; they are read as those of the {family} family, by"
            f" the ids that occur. If that is right, add --family {family}; nmpm fit needs --data.family {family}."
        )
    notes = metadata.extra.get("conversion")
    yield from [note for note in notes if isinstance(note, str)] if isinstance(notes, list) else []
