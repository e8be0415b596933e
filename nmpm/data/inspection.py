"""Summarises a dataset and reports its anomalies, in one pass over the trajectories."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from nmpm._support.messages import one_line, span
from nmpm._support.progress import progress_bar
from nmpm.data.array_checks import check_end
from nmpm.data.dataset_checks import DatasetChecks, find_shared_runs
from nmpm.data.families import guess_family
from nmpm.data.fields import FieldFacts, FieldSurvey, Kind
from nmpm.data.findings import Finding, Severity, merge_findings, sort_findings
from nmpm.data.format import METADATA_FILE, SPLITS, Metadata, Split, find_split, split_paths, split_renames
from nmpm.data.grid_rule import GridCost, GridFacts, Machine, grid_cost, recommended_cells
from nmpm.data.metadata import FOUND, load_json, parse_metadata
from nmpm.data.sources import FolderSource
from nmpm.data.spacing import neighbour_distance
from nmpm.data.statistics import MotionStatistics, extent_of, find_disagreements, notes_on_lengths
from nmpm.data.survey import RecordedMotion, Survey
from nmpm.errors import ConfigError, DataError, NmpmError
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
    costs: dict[int, GridCost]  # of a training on each grid, by its cells along the longest side


def inspect(
    source: FolderSource, trajectories: int | None = None, measure: Callable[[int], Machine] | None = None
) -> Inspection:
    """Inspects a dataset, with a progress bar; what `nmpm fit` would refuse becomes a finding.

    Args:
        source: The dataset, and what the user states about it.
        trajectories: Number of evenly spaced trajectories of each split to read; about 256 MiB when left out.
        measure: Measures the machine that trains in so many dimensions; two cores of a usual one when left out.

    Raises:
        DataError: if there is no dataset, or no trajectory can be read.
    """
    data = open_dataset(source)
    metadata, splits, scene = data.metadata, data.splits, data.scene
    samples = {
        name: split.sample(_BYTES) if trajectories is None else split.spread(trajectories)
        for name, split in splits.items()
    }
    first = next(iter(splits))
    spacing = neighbour_distance(splits[first], samples[first], metadata)
    spacing = spacing or max(high - low for low, high in metadata.bounds) / 64
    survey, statistics = Survey(splits, metadata, scene, spacing), MotionStatistics(metadata)
    problems = [Finding("metadata", Severity.CONTRADICTION, problem) for problem in data.problems + survey.problems]
    checks = DatasetChecks(metadata)
    shapes: dict[str, tuple[int, ...]] = {}
    facts = FieldSurvey(metadata)
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
                facts.add(split, index, dict.fromkeys((*metadata.fields, *possible)))
                motion = RecordedMotion(trajectory, metadata, f"{name} {split.names[index]}")
                checks.add(motion)
                survey.add(motion)
                if name == first:
                    statistics.add(trajectory)
            except DataError as error:
                problems.append(Finding("unreadable", Severity.CONTRADICTION, str(error)))
            advance()
    if not np.isfinite(survey.observed.lower).all():
        raise DataError(f"{data.source.folder}: none of its trajectories could be read. {problems[0].sentence}")
    findings = [*problems, *find_shared_runs(splits, metadata, spacing), *checks.result()]
    if len(samples[first]) == len(splits[first]):  # stated are those of the whole first split
        differences = find_disagreements(statistics.result(), metadata.extra)
        findings += [Finding("statistics", Severity.ODDITY, sentence) for sentence in differences]
    stated = [metadata.extra.get(f"sequence_length_{name}") for name in splits]
    if "sequence_length" not in metadata.extra.get(FOUND, {}):
        lengths = notes_on_lengths(survey.frames, metadata, [length for length in stated if isinstance(length, int)])
        findings += [Finding("sequence length", Severity.NOTE, sentence) for sentence in lengths]
    (occupied, occupied_each), grids = survey.occupied(), survey.grids()
    machine = measure(metadata.dim) if measure else Machine()
    fall = np.median(survey.falls or [np.zeros(metadata.dim)], axis=0) / metadata.dt**2
    rests = [rest for rest in survey.rests if rest is not None]
    materials = scene.materials if scene else tuple(survey.materials)
    return Inspection(
        path=str(source.path),
        dim=metadata.dim,
        dt=metadata.dt,
        splits={
            name: SplitFacts(len(sizes), len(samples[name]), *map(_range, zip(*sizes, strict=True)))
            for name, sizes in survey.sizes.items()
        },
        materials={name: _range(numbers) for name, numbers in survey.materials.items()},
        stated_bounds=metadata.bounds,
        observed=survey.observed.intervals,
        domain=tuple(survey.domain),
        boundary=scene.boundary if scene else metadata.boundary,
        gravity=scene.gravity if scene else metadata.gravity,
        first_acceleration=tuple(fall.tolist()),
        spacing=spacing,
        varies=(*survey.varies(), *(name for name, field in facts.items() if field.kind != "constant")),
        fields=shapes,
        grids=grids,
        recommended=recommended_cells(grids, survey.particles, machine),
        occupied=occupied,
        occupied_each=occupied_each,
        rest=(int(np.median(rests)), min(rests), max(rests)) if rests else None,
        restless=len(survey.rests) - len(rests),
        found=dict(metadata.extra.get(FOUND, {})),
        notes=tuple(_notes(source, data.source, metadata)),
        findings=sort_findings(findings),
        channels={name: _describe_channels(name, field, metadata, materials) for name, field in facts.items()},
        costs={grid.cells: grid_cost(grid.shape, survey.particles, machine) for grid in grids},
    )


def _range(values: Sequence[int]) -> Range:
    return min(values), max(values)


def _describe_channels(name: str, field: FieldFacts, metadata: Metadata, materials: tuple[str, ...]) -> str:
    """How a field varies, and the input channels that it makes."""
    if field.kind == "constant":
        return f"{_DIFFERS[field.kind]}, {field.low:.4g}: no channel"
    varies = f"{_DIFFERS[field.kind]}, {span((field.low, field.high))}"
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


@dataclass(frozen=True)
class OpenedDataset:
    """A dataset, as far as it can be read."""

    source: FolderSource  # with a guessed family where neither metadata nor user state the particle types
    splits: dict[str, Split]  # those that can be opened; at least one
    metadata: Metadata  # with values from the trajectories where the file has none; types without a name move
    scene: Scene | None  # None where it cannot be inferred
    problems: list[str]


def open_dataset(source: FolderSource) -> OpenedDataset:
    """Opens a dataset as far as it can be read; raises a DataError if no split can be opened."""
    folder, problems = source.folder, list[str]()
    if source.options.changes_positions:
        source = FolderSource(folder, source.options.of_converted)
    splits: dict[str, Split] = {}
    for name, path in split_paths(folder).items():
        try:
            splits[name] = Split(path)
        except DataError as error:
            problems.append(str(error))
    if not splits and problems:
        raise DataError(problems[0])
    find_split(folder, *SPLITS)
    problems += [f"{folder}: {rename}" for rename in split_renames(folder)]
    plain, wrong = dict[str, Any](), list[str]()
    unread = True  # then no key needs to be named
    try:
        plain, unread = load_json(folder / METADATA_FILE), False
    except DataError as error:
        problems.append(str(error))
    ids = sorted({i for split in splits.values() for n in range(len(split)) for i in split.particle_type(n).tolist()})
    if source.options.family is None and plain.get("particle_types") is None:
        source = FolderSource(folder, replace(source.options, family=guess_family(ids, plain)))
    metadata = _read_metadata(source, plain, next(iter(splits.values())), ids, wrong, unread)
    try:
        # A gravity that contradicts the file's is a problem that the scene reports.
        gravity = source.options.gravity if metadata.gravity is None else None
        metadata = replace(source.options, gravity=gravity).apply_to(metadata)
    except ConfigError as error:
        wrong.append(str(error))
    if unknown := metadata.unknown_types(np.array(ids)):
        metadata = replace(metadata, particle_types=metadata.particle_types | {i: f"type {i}" for i in unknown})
        wrong.insert(
            0,
            f"Particle type {', '.join(map(str, unknown))} is not in the metadata; it is taken for a moving material"
            f" here. To train on it, name it: nmpm convert FOLDER NEW --types {unknown[0]}=sand.",
        )
    scene = None
    try:
        scene = source.scene
    except NmpmError as error:
        wrong = wrong or [str(error)]
    return OpenedDataset(source, splits, metadata, scene, problems + wrong)


def _read_metadata(
    source: FolderSource, plain: dict[str, Any], split: Split, ids: list[int], problems: list[str], unread: bool
) -> Metadata:
    """Metadata of a JSON object whose keys may be missing or wrong, which is added to the problems."""
    path = source.folder / METADATA_FILE
    if plain.get("dim") not in (None, split.dim):
        problems.append(f"{path}: dim = {one_line(plain['dim'], 40)}, but positions have {split.dim} axes.")
        plain = plain | {"dim": split.dim}
    try:
        extent = extent_of(split.read(0).position).intervals
    except DataError:
        extent = ((0.0, 1.0),) * split.dim
    substitutes = {
        "dim": split.dim,
        "bounds": tuple((low, high if high > low else low + 1) for low, high in extent),
        "dt": 1.0,
        "sequence_length": split.frames(0),
        "particle_types": {i: f"type {i}" for i in ids},
    }
    metadata = parse_metadata(plain, path, source.options.family, None, [] if unread else problems, substitutes)
    if missing := [key for key in ("bounds", "dt") if key not in plain]:
        problems.append(f"{path}: without {' and '.join(missing)}, lengths and times here are the file's own units.")
    return metadata


_TRAJECTORIES = {"train": 2, "valid": 1, "test": 1}
_START_BYTES = 4 * 2**20  # of positions of a split's first trajectory; of larger ones the first frames are read
_START_FRAMES = 40  # at least
_COMPARED = 20  # trajectories of a split
_SHOWN, _WIDTH = 3, 120  # findings in a warning, and characters of a line
_NEED_ALL_FRAMES = frozenset({"still particles", "far bounds", "different domains"})


def contradictions_warning(source: FolderSource) -> str:
    """Up to five lines that name contradictions in a sample of a dataset; empty if there are none."""
    try:
        findings = find_contradictions(source)
    except DataError:  # the training names what cannot be read
        return ""
    if not findings:
        return ""
    shown = [f"  - {one_line(f'{finding.kind}: {finding.sentence}', _WIDTH)}" for finding in findings[:_SHOWN]]
    more = f" (and {len(findings) - _SHOWN} more)" if len(findings) > _SHOWN else ""
    command = shlex.join(["nmpm", "inspect", str(source.path), *source.options.arguments])
    return "\n".join(["Warning: these data contradict themselves:", *shown, f"  All of it{more}: {command}", ""])


def find_contradictions(source: FolderSource) -> tuple[Finding, ...]:
    """Contradictions in a sample of a dataset, one of each kind; raises a DataError if it cannot be read."""
    splits = {name: Split(path) for name, path in split_paths(source.folder).items()}
    checks, complete = DatasetChecks(source.metadata), True
    for name, split in splits.items():
        start = Split(split.path, slice(max(_START_FRAMES, _START_BYTES // (4 * split.particles(0) * split.dim))))
        for index in split.spread(_TRAJECTORIES[name]):
            trajectory = start.read_with_fields(index)
            complete &= len(trajectory.position) == split.frames(index)
            checks.add(RecordedMotion(trajectory, source.metadata, f"{name} {split.names[index]}"))
    shared = find_shared_runs(splits, source.metadata, checks.spacing, _COMPARED)
    merged = merge_findings([*shared, *checks.result()], checks.trajectories)
    left_out = frozenset[str]() if complete else _NEED_ALL_FRAMES
    return tuple(
        finding for finding in merged if finding.severity == Severity.CONTRADICTION and finding.kind not in left_out
    )
